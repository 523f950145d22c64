"""Real pushes of a square through the trajectory filter: its start known to 5 mm and 5 degrees, then contact alone.

python -m scripts.real_trajectories run     # needs RUMI_DATA; again to go on
python -m scripts.real_trajectories show
python -m scripts.real_trajectories figure

Stretches without knocks of github.com/mcubelab/cpush. What the filter is told: the tip's path, that it touches all
along, and a start drawn about the true one (by the seed). "simulated" is the default, fitted to mugs; "library" has
friction, lever, centre and residual of `PushPosterior.prior`; "learnt" has seen ten stretches of 50 mm of the other
runs, and the shifts of tip and square by them; "exact start" is a start known to 0.1 mm and 0.1 degrees. A "reference"
is the exact posterior by the learnt push density (`scripts.bench.push_reference`), whatever a filter does with it;
"sliding known" takes that density's mean for exact, so that the start alone is in doubt.
"Straight ahead" takes the square to lie along the tip's way, as a controller that sees it would hold it: no belief.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.belief.pushed_object import PushedObject
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.cli import script
from rumi.dynamics.push_posterior import PushPosterior
from rumi.dynamics.push_registration import as_tracked, put_right
from rumi.dynamics.pushed_body import ObservedPush
from rumi.metrics.calibration import checked, covered
from rumi.resampling import resample_systematic
from rumi.seeding import split
from scripts.bench.push_reference import Contact, weighed_ends
from scripts.bench.real_pushes import TIP_M, long_pushes, square_body
from scripts.bench.square_trajectories import DRAWS, TALL_M, followed, motion_of, sensed, square_object
from scripts.experiment import FIGURES, Experiment, Line
from scripts.reproduce.cells import table
from sdf import se3
from sdf.so3 import wrap
from sdf.symmetry import Symmetries

HALF_M = 0.045
START_M, START_RAD = 0.005, math.radians(5.0)
_LEARNT, _PUSH_PARTICLES = 10, 512
_KEPT = 1000

FILTERED = {"simulated": 1.0, "library": 1.0, "learnt": 1.0, "learnt, exact start": 0.02}
"""Models that the filter runs, with the start's deviation over 5 mm and 5 degrees."""

_KNOWN = "reference, sliding known"
REFERENCES = {
    "reference": (1.0, Contact()),
    "reference, no contact": (1.0, Contact(first=0.0, each=0.0)),
    "reference, contact to 0.3 mm at every instant": (1.0, Contact(0.0003, each=1.0)),
    "reference, start to 2 mm and 2 degrees": (0.4, Contact()),
    "reference, start to 1 mm and 1 degree": (0.2, Contact()),
    "reference, start to 0.5 mm and 0.5 degrees": (0.1, Contact()),
    "reference, exact start": (0.02, Contact()),
    _KNOWN: (1.0, Contact()),
}
"""The same, and what is known of the contact."""

HELD = "straight ahead"
MODELS = (*FILTERED, *REFERENCES, HELD)
WAYS = ("50 mm", "100 mm", "200 mm")


@cache
def believed_of(model: str, run: str) -> PushPosterior:
    """Push density for a stretch of a run: the library's, or what ten stretches of other runs made of it."""
    if model == "library":
        return PushPosterior.prior(_PUSH_PARTICLES)
    random = split(0, f"long pushes {run}")
    others = [own for name, own in long_pushes(0.05, 26) if name != run]
    chosen = torch.randperm(len(others), generator=random)[:_LEARNT].tolist()
    return PushPosterior.prior(_PUSH_PARTICLES).update([others[i] for i in chosen], square_body(), random)


def prior_of(model: str, run: str) -> tuple[PoseTrajectorySettings, PushedObject, Tensor]:
    """A model's motion prior for a stretch of a run, the object, and the shifts of tip and square."""
    body = square_body()
    sensor = sensed(START_M * FILTERED[model])
    if model == "simulated":
        return sensor, square_object(body, HALF_M, body.support.centre), torch.zeros(5, dtype=torch.float64)
    believed = believed_of(model.split(",")[0], run)
    own, centre = motion_of(believed, body, sensor)
    return own, square_object(body, HALF_M, centre), torch.tensor(believed.registration.mean, dtype=torch.float64)


def measure(model: str, way: str, seed: int) -> dict[str, Any]:
    """Errors of all stretches of a way, with a start of their own each; the belief's medians are what is compared."""
    length = 1e-3 * float(way.split()[0])
    errors, turns, levels, widths = [], [], [], []
    for index, (run, push) in enumerate(long_pushes(length, round(500 * length) + 1)):
        random = split(seed, f"real trajectories {index}")
        told = torch.randn(3, generator=random, dtype=torch.float64)
        poses = _ends(model, run, push, told, random)
        off = wrap(poses[:, 2] - poses[0, 2])
        turn = poses[0, 2] + off.median()
        middle = poses[:, :2].median(0).values
        errors.append(1e3 * float((middle - push.end[:2]).norm()))
        turns.append(float(wrap(turn - push.end[2]).abs().rad2deg()))
        if len(poses) > 1:
            belief, true = (se3.from_planar(part, TALL_M) for part in (poses, push.end))
            found = checked(PoseBelief.uniform(belief), true, Symmetries.none(), within_m=0.005, within_rad=0.175)
            levels.append(found.both)
            place = (poses[:, :2] - middle).norm(dim=-1).median()
            widths.append((1e3 * float(place), float((off - off.median()).abs().median().rad2deg())))
    return {"mm": errors, "degrees": turns, "levels": levels, "foreseen": widths}


def _ends(model: str, run: str, push: ObservedPush, normal: Tensor, random: torch.Generator) -> Tensor:
    """Poses that stand for the belief at the end of a push, or the one that is taken for it."""
    scale = torch.tensor([START_M, START_M, START_RAD], dtype=torch.float64)
    if model == HELD:
        way = push.path[-1, :2] - push.path[0, :2]
        place = push.path[-1, :2] + (HALF_M + TIP_M) * way / way.norm()
        return torch.cat((place, torch.atan2(way[1:], way[:1])))[None]
    if model in REFERENCES:
        share, contact = REFERENCES[model]
        told = push.start + share * scale * normal
        starts = told + share * scale * torch.randn(DRAWS, 3, generator=random, dtype=torch.float64)
        believed = believed_of("learnt", run)
        if model == _KNOWN:
            believed = _certain(believed)
        ends, weights = weighed_ends(push, starts, believed, square_body(), contact, random)
        return ends[resample_systematic(weights, _KEPT, generator=random)]
    own, square, shifts = prior_of(model, run)
    scale, tip = FILTERED[model] * scale, push.path.clone()
    tip[:, :2] += shifts[:2]
    told = put_right(push.start + scale * normal, shifts)
    return as_tracked(followed(told, scale, tip, own, square, random, half_m=HALF_M), shifts)


def _certain(believed: PushPosterior) -> PushPosterior:
    """The mean of a push density, taken for exact."""
    residual = replace(believed.residual, floor_m=(1e-6,) * 3, share=(1e-6,) * 3, tails=100.0)
    mean = (believed.log_weights.exp() @ believed.parameters)[None]
    return replace(
        believed, parameters=mean, log_weights=mean.new_zeros(1), residual=residual, white=mean.new_zeros(1, 6)
    )


def show(lines: list[Line], chosen: Mapping[str, tuple[Any, ...]]) -> str:
    """A row for each model and way: median errors, what the belief foresees of them, and what its regions hold."""
    rows = []
    for way in chosen.get("way", WAYS):
        for model in chosen.get("model", MODELS):
            own = [line for line in lines if (line["model"], line["way"]) == (model, way)]
            if not own:
                continue
            errors = [_middle(np.array([line[name] for line in own])) for name in ("mm", "degrees")]
            levels = [level for line in own for level in line["levels"]]
            widths = np.array([width for line in own for width in line["foreseen"]]).reshape(-1, 2)
            foreseen = "; ".join(f"{part:.1f}" for part in np.median(widths, 0)) if len(widths) else "-"
            held = ["-"] * 3
            if levels:
                held = [f"{100 * covered(levels, share):.0f}" for share in (0.5, 0.9, 0.95)]
            count = f"{len(own[0]['mm'])} x {len(own)}"
            rows.append([model, way, count, *errors, foreseen, " / ".join(held)])
    heads = ("model", "way", "stretches x starts", "mm", "degrees", "foreseen: mm; degrees", "50/90/95 % hold, %")
    return table(heads, rows)


def _middle(errors: np.ndarray) -> str:
    """Median of (starts, stretches) with its 95 % interval, by drawing stretches anew: starts of one are alike."""
    random = np.random.default_rng(0)
    drawn = [np.median(errors[:, random.integers(errors.shape[1], size=errors.shape[1])]) for _ in range(2000)]
    low, high = np.percentile(drawn, (2.5, 97.5))
    return f"{np.median(errors):.1f} [{low:.1f}, {high:.1f}]"


@dataclass(frozen=True)
class Figure:
    """Draw what the contact leaves open: two recorded pushes by nearly one path, and ends by the reference."""

    out: Annotated[Path, tyro.conf.arg(help="image file")] = FIGURES / "contact_leaves_open.png"


def draw(options: Figure) -> None:
    """Starts, tip paths and ends of a steered and an open-loop push, with draws of the reference's posterior."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    shown = ("StraightLine_2016_10_23_NoPerturbationsBlack", "StraightLine_2016_10_23_StraightLineOpenLoop")
    found = {run: push for run, push in long_pushes(0.2, 101) if run in shown}
    figure, axes = plt.subplots(1, 2, figsize=(9.0, 4.6), sharex=True, sharey=True, constrained_layout=True)
    corners = HALF_M * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    for axis, run, title in zip(axes, shown, ("closed loop: steered by the square's pose", "open loop"), strict=True):
        push, random = found[run], split(0, f"real trajectories figure {run}")
        drawn = _ends("reference", run, push, torch.zeros(3, dtype=torch.float64), random)
        for label, colour, width, poses in (
            ("sixty draws of the reference posterior's end", "C0", 0.4, drawn[:60]),
            ("start", "0.5", 1.5, push.start[None]),
            ("true end", "k", 1.5, push.end[None]),
        ):
            for number, (x, y, yaw) in enumerate(poses.tolist()):
                cos, sin = math.cos(yaw), math.sin(yaw)
                outline = corners @ np.array([[cos, sin], [-sin, cos]]) + (x, y)
                named = label if number == 0 else None
                shade = 0.5 if colour == "C0" else 1.0
                axis.plot(*(1e3 * outline.T), color=colour, lw=width, alpha=shade, label=named)
        axis.plot(*(1e3 * push.path[:, :2].T.numpy()), "C3", lw=1.5, label="path of the tip")
        axis.set_title(title)
        axis.set(xlim=(100, 520), ylim=(-150, 180), xlabel="x [mm]", aspect="equal")
    axes[0].set_ylabel("y [mm]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(options.out, dpi=120, bbox_inches="tight")
    plt.close(figure)


EXPERIMENT = Experiment(
    __doc__,
    "real_trajectories.jsonl",
    {"model": MODELS, "way": WAYS},
    measure,
    show,
    seeds="0-4",
    commands={"figure": (Figure, draw)},
)

if __name__ == "__main__":
    script(EXPERIMENT.main)
