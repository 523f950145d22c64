"""Train a contact sensor by gradient through a particle filter; the poses of the mugs touched are never known."""

import torch

from rumi.belief.contact_evidence import ContactSignalEvidence
from rumi.belief.evidence_filter import EvidenceFilter, SystematicResampler
from rumi.belief.particles import PoseBelief
from sdf import GridSDF, primitives, se3
from sensors.touch.contact_model import robot_distance

MUG = GridSDF.from_sdf(primitives.Mug(), spacing=0.004)


def poses(random, *shape):
    place, yaw = torch.randn(*shape, 2, generator=random), torch.rand(*shape, 1, generator=random)
    return se3.from_planar(torch.cat((0.02 * place, 6.2832 * yaw), -1))


def record(sensor, episodes, touches, random):
    middle = torch.randn(episodes, touches, 1, 3, generator=random) * torch.tensor([0.045, 0.045, 0.015])
    probes = middle + torch.tensor([0, 0, 0.04]) + 0.004 * torch.randn(episodes, touches, 12, 3, generator=random)
    chance = sensor(robot_distance(MUG, poses(random, episodes, 1), probes)[:, 0]).detach()
    return probes, torch.rand(chance.shape, generator=random) < chance


def log_evidence(sensor, probes, signals, particles, random):
    track, total = EvidenceFilter(SystematicResampler(random), trigger=0.3), 0.0
    belief = PoseBelief.uniform(poses(random, len(probes), particles))
    for probe, signal in zip(probes.split(1, 1), signals.split(1, 1), strict=True):
        belief, log, _ = track(belief, [ContactSignalEvidence(MUG, probe, sensor, signal)])
        total = total + log
    return total


def train(sensor, probes, signals, particles=200, steps=60, seed=0):
    optimiser = torch.optim.Adam(sensor.parameters(), lr=0.1)
    for step in range(steps):
        loss = -log_evidence(sensor, probes, signals, particles, torch.Generator().manual_seed(seed + step)).mean()
        optimiser.zero_grad(), loss.backward(), optimiser.step()
