"""Train a contact sensor by gradient through a particle filter; the poses of the mugs touched are never known."""

import torch

from rumi.belief.contact_evidence import ContactSignalEvidence
from rumi.belief.evidence_filter import EvidenceFilter, SystematicResampler
from rumi.belief.particles import PoseBelief
from rumi.belief.prior import PlanarPrior
from rumi.belief.rejuvenation import rejuvenate
from sdf import GridSDF, primitives, se3
from sensors.touch.contact_model import robot_distance

MUG = GridSDF.from_sdf(primitives.Mug(), spacing=0.004)
PRIOR = PlanarPrior(torch.zeros(1, 3), torch.tensor([0.02, 0.02, 100.0]))  # 100 radians: any yaw


def record(sensor, episodes, touches, random):
    middle = torch.randn(episodes, touches, 1, 3, generator=random) * torch.tensor([0.045, 0.045, 0.015])
    probes = middle + torch.tensor([0, 0, 0.04]) + 0.004 * torch.randn(episodes, touches, 12, 3, generator=random)
    truth = se3.from_planar(PRIOR.sample(episodes, 1, generator=random))
    chance = sensor(robot_distance(MUG, truth, probes)[:, 0]).detach()
    return probes, torch.rand(chance.shape, generator=random) < chance


def log_evidence(sensor, probes, signals, particles, random):
    track, total = EvidenceFilter(SystematicResampler(random)), 0.0
    belief = PoseBelief.uniform(se3.from_planar(PRIOR.sample(len(probes), particles, generator=random)))
    for k in range(1, probes.shape[1] + 1):
        new, every = (ContactSignalEvidence(MUG, probes[:, s:k], sensor, signals[:, s:k]) for s in (k - 1, 0))
        belief, log, info = track(belief, [new])
        belief = rejuvenate(belief, [every], PRIOR.log_density, rows=info.resampled, generator=random)
        total = total + log
    return total


def train(sensor, probes, signals, particles=200, steps=60, seed=0):
    optimiser = torch.optim.Adam(sensor.parameters(), lr=0.1)
    for step in range(steps):
        loss = -log_evidence(sensor, probes, signals, particles, torch.Generator().manual_seed(seed + step)).mean()
        optimiser.zero_grad(), loss.backward(), optimiser.step()
