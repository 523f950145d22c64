"""Real pushes of a square through the trajectory filter: its start known to 5 mm and 5 degrees, then contact alone.

python -m scripts.real_trajectories run     # needs RUMI_DATA; again to go on
python -m scripts.real_trajectories show

Stretches without knocks of github.com/mcubelab/cpush. What the filter is told: the tip's path, that it touches all
along, and a start drawn about the true one (by the seed). "simulated" is the default, fitted to mugs; "real" has
friction, lever and residual of `rumi.dynamics.push_posterior`; "dead reckoning" is that without the contact; "learnt"
has seen ten stretches of 50 mm of the other runs; "learnt, exact start" knows the start to 0.1 mm and 0.1 degrees.
"""

import math
import statistics
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import torch

from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterSettings
from rumi.belief.pose_trajectories import NOISE, PHYSICS, PushedObject, Trajectories
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.trajectory_history import History, Kind, Segment
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.cli import script
from rumi.dynamics.push_posterior import PushPosterior
from rumi.metrics.calibration import checked, covered
from rumi.seeding import split
from scripts.bench.real_pushes import TIP_M, long_pushes, square_body
from scripts.experiment import Experiment, Line
from scripts.reproduce.cells import table
from sdf import se3
from sdf.grid_sdf import GridSDF
from sdf.primitives import Box
from sdf.so3 import wrap
from sdf.symmetry import Symmetries
from sensors.discrepancy import Discrepancy

HALF_M, TALL_M = 0.045, 0.03
START_M, START_RAD = 0.005, math.radians(5.0)
EXACT, _LEARNT = "learnt, exact start", 10
_CONTACT_M = 0.001  # deviation of the tip's distance while it touches
_ARM_M = START_M / START_RAD / math.sqrt(2.0)


def prior_of(model: str, run: str) -> PoseTrajectorySettings:
    """A model's motion prior for a stretch of a run; the contact is a felt point, the tip's centre."""
    sensor = PoseTrajectorySettings(
        seen_sd_m=START_M * (0.02 if model == EXACT else 1.0),
        outliers=1e-4,
        felt_m=TIP_M,
        felt_sd_m=_CONTACT_M,
        felt_weight=1.0,
        ahead=(0.0, 0.0),
        centre_change_m=0.0,
    )
    if model == "simulated":
        return sensor
    believed = PushPosterior.prior(256)
    if model in ("learnt", EXACT):
        random = split(0, f"long pushes {run}")
        others = [own for name, own in long_pushes(0.05, 26) if name != run]
        chosen = torch.randperm(len(others), generator=random)[:_LEARNT].tolist()
        believed = believed.update([others[i] for i in chosen], square_body(), random)
    weights = believed.log_weights.exp()
    mean = weights @ believed.parameters
    deviation = (weights @ (believed.parameters - mean).square()).sqrt().tolist()
    spread = square_body().support.spread
    return replace(
        sensor,
        friction=(math.exp(mean[0]), deviation[0]),
        lever_ratio=(math.exp(mean[1]), deviation[1]),
        centre_m=deviation[6] * spread,
        along=believed.residual.share[0],
        across=believed.residual.share[1],
        turn_rad_per_m=believed.residual.share[2] / spread,
        m_per_rad=spread,
        tails=0.25,
        shared=1.0,
    )


MODELS = ("simulated", "real", "dead reckoning", "learnt", EXACT)
WAYS = ("50 mm", "100 mm", "200 mm")


def measure(model: str, way: str, seed: int) -> dict[str, Any]:
    """Errors of all stretches of a way, with a start of their own each."""
    length, square = 1e-3 * float(way.split()[0]), _square()
    scale = torch.tensor([START_M, START_M, START_RAD], dtype=torch.float64) * (0.02 if model == EXACT else 1.0)
    own_of = cache(lambda run: prior_of(model, run))
    errors, turns, levels = [], [], []
    for index, (run, push) in enumerate(long_pushes(length, round(500 * length) + 1)):
        random = split(seed, f"real trajectories {index}")
        own = own_of(run)
        settings = FilterSettings(motion="trajectory", trajectories=own)
        followed = PoseTrajectoryFilter(
            settings, Discrepancy(square.sdf, 0.08, free_scale=80.0, tolerance=1e-3), square
        )
        told = push.start + scale * torch.randn(3, generator=random, dtype=torch.float64)
        now = _about(told, scale, own, square, random)
        flat = now.log_likelihood.new_zeros(len(now)).log_softmax(-1)
        path = torch.stack((push.path[:-1], push.path[1:]), 1)
        for k, part in enumerate(path.split(own.instants)):
            touches = part[:, 1].clone()
            touches[:, 2] = 0.0  # of the object's middle height
            count = torch.arange(len(part))
            weight = torch.full((len(part),), 0.0 if model == "dead reckoning" else 1.0 / len(part))
            felt = torch.full_like(count, int(Kind.FELT))
            segment = Segment(part, True, touches, count, felt, weight.double())
            now = followed.absorbed(now, flat, segment, random, opens=k == 0, closes=True)
        belief = PoseBelief.uniform(se3.from_planar(now.pose, TALL_M))
        mean = now.pose[:, :2].mean(0)
        turn = now.pose[0, 2] + wrap(now.pose[:, 2] - now.pose[0, 2]).mean()
        errors.append(1e3 * float((mean - push.end[:2]).norm()))
        turns.append(float(wrap(turn - push.end[2]).abs().rad2deg()))
        true = se3.from_planar(push.end, TALL_M)
        levels.append(checked(belief, true, Symmetries.none(), within_m=0.005, within_rad=0.175).both)
    return {"mm": errors, "degrees": turns, "levels": levels}


def _square() -> PushedObject:
    body = square_body()
    sdf = GridSDF.from_sdf(Box([HALF_M, HALF_M, TALL_M]), 0.003)
    around = torch.linspace(0.0, 2.0 * math.pi, 25, dtype=torch.float64)[:-1]
    tip = TIP_M * torch.stack((around.cos(), around.sin()), -1)
    assert hasattr(body.outline, "values")
    return PushedObject(
        sdf, TALL_M, body.outline, body.support.centre, body.support.spread, tip, tip.new_zeros(1, 3), TALL_M
    )


def _about(
    told: torch.Tensor,
    scale: torch.Tensor,
    own: PoseTrajectorySettings,
    square: PushedObject,
    random: torch.Generator,
) -> Trajectories:
    """Particles of a start that is known to so much: points on the sides it was told of hold it, in moves too."""
    side = torch.tensor([-_ARM_M, _ARM_M], dtype=torch.float64)
    local = torch.cat([torch.stack((torch.full_like(side, s * HALF_M), side), -1) for s in (-1, 1)])
    local = torch.cat((local, local.flip(-1)))
    cos, sin = told[2].cos(), told[2].sin()
    place = told[:2] + torch.stack((cos * local[:, 0] - sin * local[:, 1], sin * local[:, 0] + cos * local[:, 1]), -1)
    points = torch.cat((place, torch.zeros_like(place[:, :1])), -1)
    none = torch.zeros(len(points), dtype=torch.long)
    weight = torch.full((len(points),), 0.25, dtype=torch.float64)
    view = Segment(torch.zeros(1, 2, 3, dtype=torch.float64), False, points, none, none, weight)
    start = told + scale * torch.randn(300, 3, generator=random, dtype=torch.float64)
    some = start[: own.particles]
    physics = torch.randn(len(some), PHYSICS, generator=random, dtype=torch.float64)
    noise = torch.randn(len(some), 1, NOISE, generator=random, dtype=torch.float64)
    history = History.empty().appended(view)
    poses = some[:, None].repeat(1, 2, 1)
    given = Trajectories(physics, noise, poses, some.new_zeros(len(some), 1), history, start)
    return given.replayed(square, own, history, torch.zeros(len(some), dtype=torch.long))


def show(lines: list[Line], chosen: Mapping[str, tuple[Any, ...]]) -> str:
    """A row for each model: medians over stretches and starts, and what regions of 90 % hold, by way."""
    rows = []
    for model in chosen.get("model", MODELS):
        row = [model]
        for way in WAYS:
            own = [line for line in lines if (line["model"], line["way"]) == (model, way)]
            mm, degrees, levels = (
                [value for line in own for value in line[name]] for name in ("mm", "degrees", "levels")
            )
            held = 100 * covered(levels, 0.9)
            row.append(f"{statistics.median(mm):.1f}; {statistics.median(degrees):.1f}; {held:.0f} %" if own else "-")
        rows.append(row)
    return table(("model", *(f"{way}: mm; degrees; held" for way in WAYS)), rows)


EXPERIMENT = Experiment(
    __doc__, "real_trajectories.jsonl", {"model": MODELS, "way": WAYS}, measure, show, seeds="1000-1001"
)

if __name__ == "__main__":
    script(EXPERIMENT.main)
