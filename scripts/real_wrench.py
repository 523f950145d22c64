"""Real pushes of blocks through the trajectory filter with and without the force at the tip, the start roughly known.

python -m scripts.real_wrench run     # needs RUMI_DATA; again to go on
python -m scripts.real_wrench show

Bags of github.com/mcubelab/cpush (`scripts.bench.vicon_pushes`): eleven pushes of an aluminium, a plastic and a steel
block. What the filter is told: the tip's path, that it touches all along, a start drawn 5 mm and 5 degrees about the
true one (by the seed), and the direction of the force. Friction, lever, centre and residual are the library's prior's:
no push of these blocks is learnt from. Their size and the trackers' shifts are found from all bags of a block.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from rumi.belief.particles import PoseBelief
from rumi.cli import script
from rumi.dynamics.push_posterior import PushPosterior
from rumi.metrics.calibration import checked, covered
from rumi.seeding import split
from scripts.bench.square_trajectories import TALL_M, followed, motion_of, sensed, square_object
from scripts.bench.vicon_pushes import block_of, force_pushes
from scripts.experiment import Experiment, Line
from scripts.reproduce.cells import table
from scripts.reproduce.intervals import bootstrap_mean
from sdf import se3
from sdf.so3 import wrap
from sdf.symmetry import Symmetries

START_M, START_RAD = 0.005, math.radians(5.0)
MODELS = ("tip alone", "and the force")
WAYS = ("100 mm", "200 mm")
CHOSEN = (
    "Al_block Test_metal_2",
    "Plastic_block Test_changing_vel_0",
    "Plastic_block Test_changing_vel_2",
    "St_block Test_st_2",
    "St_block Test_st_4",
)
"""Bags on which the force's worth and deviation were chosen; the others are reported apart."""


def measure(model: str, way: str, seed: int, worth: float = 0.2, rad: float = 0.15) -> dict[str, Any]:
    """Errors of every bag's stretch, with a start of its own."""
    found: dict[str, list[Any]] = {"bags": [], "mm": [], "degrees": [], "levels": []}
    for own in force_pushes(1e-3 * float(way.split()[0])):
        random = split(seed, f"real wrench {own.name}")
        block = block_of(own.block)
        settings, centre = motion_of(PushPosterior.prior(512), block.body, sensed(START_M))
        scale = torch.tensor([START_M, START_M, START_RAD], dtype=torch.float64)
        told = own.push.start + scale * torch.randn(3, generator=random, dtype=torch.float64)
        poses = followed(
            told,
            scale,
            own.push.path,
            replace(settings, force_rad=rad),
            square_object(block.body, block.half_m, centre),
            random,
            half_m=block.half_m,
            forces=own.force if model == "and the force" else None,
            worth=worth,
        )
        off = wrap(poses[:, 2] - poses[0, 2])
        belief, true = (se3.from_planar(part, TALL_M) for part in (poses, own.push.end))
        held = checked(PoseBelief.uniform(belief), true, Symmetries.none(), within_m=0.005, within_rad=0.175)
        found["bags"].append(own.name)
        found["mm"].append(1e3 * float((poses[:, :2].median(0).values - own.push.end[:2]).norm()))
        found["degrees"].append(float(wrap(poses[0, 2] + off.median() - own.push.end[2]).abs().rad2deg()))
        found["levels"].append(held.both)
    return found


def show(lines: list[Line], chosen: Mapping[str, tuple[Any, ...]]) -> str:
    """A row for each way and half of the bags: medians without and with the force, and their paired difference."""
    rows = []
    for way in chosen.get("way", WAYS):
        by_model = {name: [line for line in lines if (line["model"], line["way"]) == (name, way)] for name in MODELS}
        if not all(by_model.values()):
            continue
        bags = by_model[MODELS[0]][0]["bags"]
        for half, some in (("chosen on", True), ("others", False)):
            at = [k for k, bag in enumerate(bags) if (bag in CHOSEN) == some]
            cells = []
            for own in by_model.values():
                mm, degrees = (np.array([line[name] for line in own])[:, at] for name in ("mm", "degrees"))
                levels = [line["levels"][k] for line in own for k in at]
                held = "/".join(f"{100 * covered(levels, share):.0f}" for share in (0.5, 0.9, 0.95))
                cells.append(f"{np.median(mm):.1f}; {np.median(degrees):.1f}; {held}")
            paired = [_paired(by_model, name, at) for name in ("mm", "degrees")]
            rows.append([way, f"{half} ({len(at)} x {len(by_model[MODELS[0]])})", *cells, "; ".join(paired)])
    names = (f"{name}: mm; degrees; 50/90/95 % hold" for name in MODELS)
    return table(("way", "bags x starts", *names, "mean difference: mm; degrees"), rows)


def _paired(by_model: Mapping[str, list[Line]], name: str, at: list[int]) -> str:
    """Mean of what the force changes, with its 95 % interval, by drawing bags anew; starts are the same."""
    without, felt = ({line["seed"]: np.array(line[name])[at] for line in own} for own in by_model.values())
    change = np.array([felt[seed] - without[seed] for seed in sorted(felt.keys() & without.keys())]).mean(0)
    return "{:.1f} [{:.1f}, {:.1f}]".format(*bootstrap_mean(change.tolist()))


EXPERIMENT = Experiment(__doc__, "real_wrench.jsonl", {"model": MODELS, "way": WAYS}, measure, show, seeds="0-4")

if __name__ == "__main__":
    script(EXPERIMENT.main)
