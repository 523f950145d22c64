"""Contact models and resampling rules compared on one push of a box by a round finger (touch-only paper, Table II)."""

import itertools
import math
import time
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.prior import PlanarPrior
from rumi.belief.trajectory_belief import TouchAction, TrajectoryBelief
from rumi.belief.trajectory_filter import TrajectoryFilter, TrajectorySettings
from rumi.dynamics.along_path import Pusher, push_along_path
from rumi.dynamics.outline import RectangleOutline
from rumi.dynamics.sliding import Sliding
from rumi.seeding import split
from sdf.so3 import wrap
from sensors.touch.contact_model import ContactModel

# particles that are carried at once: few enough for the processor's cache
_AT_ONCE = 100_000

Variant = Literal["binary", "smooth", "smooth+replay", "smooth+newcomers"]


@dataclass(frozen=True)
class PushSetup:
    """One straight push; metres and radians.

    Attributes:
        half: half of the box's sides.
        finger_m: radius of the finger.
        start: of the finger.
        length_m: of the push, along x.
        readings: contact signals along it, evenly spaced; they are the truth.
        spread: standard deviations of the box's pose (x, y, yaw) about the origin, for the prior and the truth.
        friction: between finger and box; known.
        lever_m: c of the limit surface; known.
        rates: true and false positive rate that the filters count on.
        decay: of the smooth model, 1/m.
        contact_m: distance up to which finger and box touch, for the truth and the binary model.
    """

    half: tuple[float, float] = (0.03, 0.08)
    finger_m: float = 0.03
    start: tuple[float, float] = (-0.12, 0.0)
    length_m: float = 0.1
    readings: int = 60
    spread: tuple[float, float, float] = (0.02, 0.02, 0.2)
    friction: float = 0.3
    lever_m: float = 0.0448
    rates: tuple[float, float] = (0.99, 0.01)
    decay: float = 1000.0
    contact_m: float = 1e-4


class Scores(NamedTuple):
    """How each run ended.

    Attributes:
        top_m, top_rad: mean absolute error of the ten heaviest particles, position and yaw.
        mean_m, mean_rad: error of the weighted mean.
        active: share of the particles with a weight above 1e-4.
    """

    top_m: Float[Tensor, "R"]
    top_rad: Float[Tensor, "R"]
    mean_m: Float[Tensor, "R"]
    mean_rad: Float[Tensor, "R"]
    active: Float[Tensor, "R"]


def make_filter(setup: PushSetup, variant: Variant) -> TrajectoryFilter:
    """The filter of a variant."""
    tp, fp = setup.rates
    decay = None if variant == "binary" else setup.decay
    rules = {"smooth+replay": "replay", "smooth+newcomers": "newcomers"}
    settings = TrajectorySettings(
        resampling=rules.get(variant, "none"),  # type: ignore[arg-type]
        friction=(setup.friction, setup.friction),
        lever_m=(setup.lever_m, setup.lever_m),
        substeps=1,
    )
    like = torch.zeros(1)
    return TrajectoryFilter(
        RectangleOutline(setup.half),
        torch.zeros(2),
        Pusher.disc(setup.finger_m, like),
        ContactModel(tp, fp, decay, tolerance=setup.contact_m),
        prior_of(setup),
        settings,
    )


def prior_of(setup: PushSetup) -> PlanarPrior:
    """One mode about the origin."""
    return PlanarPrior(torch.zeros(1, 3), torch.tensor(setup.spread))


def truth_of(setup: PushSetup, runs: int, *, generator: torch.Generator) -> tuple[Tensor, list[TouchAction]]:
    """Poses (R, 3) after the push, and its readings, one action each."""
    start = prior_of(setup).sample(runs, generator=generator)
    share = torch.linspace(0.0, 1.0, setup.readings + 1)[:, None]
    path = torch.tensor([*setup.start, 0.0]) + share * torch.tensor([setup.length_m, 0.0, 0.0])
    outline, finger = RectangleOutline(setup.half), Pusher.disc(setup.finger_m, start)
    own = Sliding(torch.zeros(2), torch.tensor(setup.lever_m), torch.tensor(setup.friction)).expand(runs)
    carried = push_along_path(start, path[None], finger, outline, own, substeps=1)
    contact = carried.distance <= setup.contact_m
    actions = [TouchAction(path[t : t + 2], contact[:, t : t + 1]) for t in range(setup.readings)]
    return carried.track[:, -1], actions


def run_variant(
    setup: PushSetup, variant: Variant, truth: Float[Tensor, "R 3"], actions: list[TouchAction], count: int, seed: int
) -> tuple[Scores, float]:
    """Scores of all runs with one variant, and how often a run was resampled on average.

    The same seed draws the same particles for every variant. There is no resampling after the last reading.
    """
    rows = max(1, _AT_ONCE // count)
    parts, resampled = [], 0.0
    for first in range(0, len(truth), rows):
        part = slice(first, first + rows)
        own = [TouchAction(action.path, action.contact[part]) for action in actions]
        belief, often = _follow(make_filter(setup, variant), own, count, f"{seed}/{first}", variant)
        resampled += often * len(belief.pose) / len(truth)
        parts.append(score(belief, truth[part]))
    return Scores(*(torch.cat(column) for column in zip(*parts, strict=True))), resampled


def _follow(
    follow: TrajectoryFilter, actions: list[TouchAction], count: int, name: str, variant: str
) -> tuple[TrajectoryBelief, float]:
    """The belief of some runs after all readings, and how often one was resampled on average."""
    runs = len(actions[0].contact)
    belief = follow.initial(runs, count, generator=split(0, f"particles/{name}"))
    random, resampled = split(0, f"{variant}/{name}"), 0.0
    for t in range(len(actions)):
        last = t == len(actions) - 1
        belief, info = follow.step(belief, actions[: t + 1], generator=random, resample=not last)
        resampled += float(info.resampled.double().mean())
    return belief, resampled


def score(belief: TrajectoryBelief, truth: Float[Tensor, "R 3"], top: int = 10) -> Scores:
    """How far a belief is from the truth; see `Scores`."""
    weights, pose = belief.log_weights.exp(), belief.pose
    apart = pose - truth[:, None]
    turn = wrap(apart[..., 2])
    place = apart[..., :2].norm(dim=-1)
    heavy = weights.topk(min(top, weights.shape[1]), dim=-1).indices
    top_m, top_rad = place.gather(1, heavy), turn.gather(1, heavy).abs()
    mean = (weights[..., None] * apart[..., :2]).sum(1).norm(dim=-1)
    # the mean turn from the truth, on the circle
    mean_turn = torch.atan2((weights * turn.sin()).sum(1), (weights * turn.cos()).sum(1)).abs()
    active = (weights > 1e-4).to(weights.dtype).mean(1)
    return Scores(top_m.mean(1), top_rad.mean(1), mean, mean_turn, active)


def compare(
    setup: PushSetup | None = None,
    *,
    runs: int = 1000,
    count: int = 100,
    exact_count: int = 0,
    variants: tuple[Variant, ...] = ("binary", "smooth", "smooth+newcomers", "smooth+replay"),
    seed: int = 0,
) -> dict[str, Any]:
    """Table II: means and 95 % intervals by variant, and differences between neighbours, paired over the runs.

    Args:
        setup: of the push.
        runs: how many.
        count: particles.
        exact_count: particles of a filter that is next to exact (smooth, never resampled), for comparison; 0 for none.
        variants: in the order in which neighbours are compared.
        seed: of all randomness.
    """
    setup = setup or PushSetup()
    truth, actions = truth_of(setup, runs, generator=split(seed, "truth"))
    columns: dict[str, dict[str, Any]] = {}
    scores: dict[str, Scores] = {}
    asked: list[tuple[str, Variant, int]] = [(name, name, count) for name in variants]
    if exact_count:
        asked.append((f"smooth, {exact_count} particles", "smooth", exact_count))
    for name, variant, particles in asked:
        begun = time.perf_counter()
        found, resampled = run_variant(setup, variant, truth, actions, particles, seed)
        scores[name] = found
        summary = {key: _interval(value) for key, value in found._asdict().items()}
        columns[name] = {**summary, "resampled": resampled, "seconds": time.perf_counter() - begun}
    pairs = {}
    for first, second in itertools.pairwise(variants):
        a, b = scores[first], scores[second]
        pairs[f"{second} - {first}"] = {key: _interval(getattr(b, key) - getattr(a, key)) for key in Scores._fields}
    return {"runs": runs, "particles": count, "seed": seed, "variants": columns, "differences": pairs}


def _interval(values: Float[Tensor, "R"]) -> tuple[float, float]:
    """Mean and half of its 95 % interval."""
    return float(values.mean()), 1.96 * float(values.std()) / math.sqrt(max(1, len(values)))


def wide(setup: PushSetup, place_m: float, turn_rad: float) -> PushSetup:
    """The same push with another spread of start poses."""
    return replace(setup, spread=(place_m, place_m, turn_rad))


PAPER = (
    "The paper has, for binary, smooth, smooth and resampled: 0.023, 0.019, 0.018 (position); 0.208, 0.185, 0.164 "
    "(yaw); 0.038, 0.077, 0.511 (active)."
)

_SHOWN = {
    "top_m": "top 10, m",
    "top_rad": "top 10, rad",
    "mean_m": "mean, m",
    "mean_rad": "mean, rad",
    "active": "active",
}


def markdown(found: dict[str, Any]) -> str:
    """Markdown: a filter a line, then the differences, each with half of its 95 % interval."""
    lines = ["| filter | " + " | ".join(_SHOWN.values()) + " | resampled | s |", "|" + "---|" * (len(_SHOWN) + 3)]
    for name, column in found["variants"].items():
        cells = [f"{column[key][0]:.4f} ± {column[key][1]:.4f}" for key in _SHOWN]
        lines.append(f"| {name} | {' | '.join(cells)} | {column['resampled']:.1f} | {column['seconds']:.1f} |")
    for name, column in found["differences"].items():
        cells = [f"{column[key][0]:+.4f} ± {column[key][1]:.4f}" for key in _SHOWN]
        lines.append(f"| {name} | {' | '.join(cells)} | | |")
    return "\n".join(lines)
