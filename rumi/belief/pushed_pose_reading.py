"""A reading's way into the belief of a pushed object's pose: push, weigh, gather evidence of faults; in one call."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.change_test import MOST, ChangeEvidence, ChangeTest
from rumi.belief.pose_reading import MotionNoise, PoseReading, pose_difference, reading_draws, update_by_reading
from rumi.dynamics.along_path import contact_arrays, push_along_path
from rumi.dynamics.outline import GridOutline, RectangleOutline
from rumi.dynamics.pushed_body import PushedBody
from rumi.dynamics.sliding import Sliding
from sdf import backend, compiled

Fault = Literal["knocked", "late", "stuck", "none of these"]
"""The object was moved by something else; the tracker's pose is old; it repeats one number; nothing known fits."""

_PASSES = 2  # contacts that are settled in a motion, at most


class PushedPoseBelief(NamedTuple):
    """Belief of an object's pose, and evidence that it is wrong.

    Attributes:
        pose: (N, 3), x, y, yaw, metres and radians.
        log_weights: (N), normalised.
        parameters: (N, 8) of how the object slides; see `rumi.dynamics.push_posterior.PARAMETERS`.
        sliding: the same, for its support.
        tool: (N, 3), of the tool's place against the tracker's, metres; its yaw is not off.
        evidence: of faults.
        trail: (T, 3), mean poses after the last readings, the latest first.
        reading: the last one.
        outliers: readings that told nothing, and readings, with what the prior counts as.
        past: the last beliefs since the last alarm, the earliest first, each with the tool's path from there on.
        fault: what the last alarm was taken for; None before the first, and once a tracker that failed fits again.
        alarm: whether this reading raised one.
    """

    pose: Float[Tensor, "N 3"]
    log_weights: Float[Tensor, "N"]
    parameters: Float[Tensor, "N 8"]
    sliding: Sliding
    tool: Float[Tensor, "N 3"]
    evidence: ChangeEvidence
    trail: Float[Tensor, "T 3"]
    reading: Float[Tensor, "3"]
    outliers: tuple[float, float]
    past: "tuple[tuple[PushedPoseBelief, Tensor], ...]" = ()
    fault: Fault | None = None
    alarm: bool = False

    def mean(self) -> Float[Tensor, "3"]:
        """Mean pose, of a belief that is near one place."""
        first = self.pose[0]
        return first + self.log_weights.exp() @ pose_difference(self.pose, first)

    def covariance(self) -> Float[Tensor, "3 3"]:
        """Of the pose."""
        off = pose_difference(self.pose, self.mean())
        return off.T @ (self.log_weights.exp()[:, None] * off)


@dataclass(frozen=True, eq=False)
class ReadingModel:
    """How readings and motions come about, and what is tested; fixed for as long as a filter is used.

    Attributes:
        body: the object and the tool.
        motion: noise of the push model.
        noise: (3), variance of a reading.
        others: (A, 3), variances that are added by outliers, far and near ones, and by knocks; see `PoseReading`.
        old: (L, 3), variances about the poses that a reading may repeat, the last one about the reading before.
        lags: readings by which those poses are old, but for the last one.
        repeats: rate of readings that repeat the last one.
        test: of knocks, of the poses that are repeated, and of far outliers, in this order.
    """

    body: PushedBody
    motion: MotionNoise
    noise: Float[Tensor, "3"]
    others: Float[Tensor, "A 3"]
    old: Float[Tensor, "L 3"]
    lags: tuple[int, ...]
    repeats: float
    test: ChangeTest

    @cached_property
    def arrays(self) -> tuple[tuple[Any, ...], tuple[Any, ...]] | None:
        """Pushes and densities as compiled versions take them, in double precision; None without such an outline."""
        pusher, outline = self.body.pusher, self.body.outline
        if not isinstance(outline, GridOutline | RectangleOutline):
            return None
        contact = contact_arrays(pusher, outline, (1, _PASSES), torch.float64)
        noises = tuple(part.numpy() for part in (self.noise, self.others, self.old))
        return contact, (*noises, np.array(self.lags), self.test.log_weights.numpy())


class ReadingTaken(NamedTuple):
    """Outcome of a reading.

    Attributes:
        pose: (N, 3), drawn given the reading.
        log_weights: (N), normalised.
        trail: (T, 3), mean poses after the last readings, this one first.
        evidence: of faults.
        log_evidence: nats against "no fault so far".
        told: posterior probability that the reading tells of the object.
        untold: that it is an outlier.
        effective: effective sample size of the weights.
    """

    pose: Float[Tensor, "N 3"]
    log_weights: Float[Tensor, "N"]
    trail: Float[Tensor, "T 3"]
    evidence: ChangeEvidence
    log_evidence: float
    told: float
    untold: float
    effective: float


def take_reading(
    model: ReadingModel,
    belief: PushedPoseBelief,
    path: Float[Tensor, "K1 3"],
    reading: Float[Tensor, "3"],
    outlier: float,
    *,
    generator: torch.Generator,
) -> ReadingTaken:
    """Push particles along the tool's path, and take a reading into them.

    Args:
        model: of readings and motions.
        belief: before them.
        path: (x, y, yaw) of the tool.
        reading: (x, y, yaw) of the object, finite.
        outlier: rate of readings that tell nothing.
        generator: of the random draws.

    Raises:
        ValueError: the densities of a reading are no numbers.
    """
    version = backend.dispatch("take_reading", belief.pose, path, reading)
    found: ReadingTaken = version(model, belief, path, reading, outlier, generator)
    return found


@backend.register("take_reading")
def _take_reading(
    model: ReadingModel,
    belief: PushedPoseBelief,
    path: Tensor,
    reading: Tensor,
    outlier: float,
    generator: torch.Generator,
) -> ReadingTaken:
    pushed = _pushed(model.body, belief, path)
    back = torch.cat((belief.trail[list(model.lags)], belief.reading[None]))
    read = PoseReading(reading, model.noise, model.others, back, model.old, (outlier, model.repeats))
    found = update_by_reading(belief.pose, pushed, belief.log_weights, model.motion, read, generator=generator)
    alternatives = torch.cat((found.others[2:], found.old, found.others[:1]))
    evidence = model.test.update(belief.evidence, alternatives - found.log_density)
    return ReadingTaken(
        found.pose,
        found.log_weights,
        followed(belief, found.mean).trail,
        evidence,
        float(model.test.log_evidence(evidence)),
        found.told,
        found.untold,
        found.effective,
    )


@backend.register("take_reading", "numba", compiled.supports)
def _take_reading_numba(
    model: ReadingModel,
    belief: PushedPoseBelief,
    path: Tensor,
    reading: Tensor,
    outlier: float,
    generator: torch.Generator,
) -> ReadingTaken:
    from rumi.belief.pushed_pose_numba import take_reading as kernel

    if model.arrays is None:
        return _take_reading(model, belief, path, reading, outlier, generator)
    contact, densities = model.arrays
    drawn = tuple(part.numpy() for part in reading_draws(len(belief.pose), generator))
    evidence = belief.evidence
    before = evidence.log_sum.numpy(), evidence.log_moment.numpy()
    pose, after, trail = (np.empty(part.shape) for part in (belief.pose, belief.log_weights, belief.trail))
    log_sum, log_moment, ratios = np.empty((3, len(evidence.log_sum)))
    sums, number = np.empty(5), int(evidence.readings) + 1
    logs = (math.log1p(-outlier - model.repeats), math.log(0.5 * outlier), math.log(model.repeats))
    numbers = np.array((*model.motion, *logs, number, MOST))
    given = (part.numpy() for part in (path, reading, belief.reading))
    found = pose, after, trail, log_sum, log_moment, ratios, sums
    kernel(_held(belief), *given, before, drawn, contact, densities, numbers, found)
    _, told, untold, effective, nats = sums.tolist()
    if math.isnan(nats):
        model.test.update(evidence, torch.from_numpy(ratios))  # which says what is wrong
    gathered = ChangeEvidence(torch.from_numpy(log_sum), torch.from_numpy(log_moment), torch.tensor(number))
    poses, weights, means = torch.from_numpy(pose), torch.from_numpy(after), torch.from_numpy(trail)
    return ReadingTaken(poses, weights, means, gathered, nats, told, untold, effective)


def moved_on(
    model: ReadingModel,
    belief: PushedPoseBelief,
    paths: Sequence[Float[Tensor, "_ 3"]],
    *,
    generator: torch.Generator,
) -> PushedPoseBelief:
    """The belief after motions of the tool, one or more, without a reading.

    Args:
        model: of motions.
        belief: before them.
        paths: (K1, 3) each, (x, y, yaw) of the tool; what is not known of a motion is added at its end.
        generator: of the random draws.
    """
    normal = [torch.randn(belief.pose.shape, generator=generator, dtype=torch.float64) for _ in paths]
    version = backend.dispatch("move_pushed", belief.pose, *paths)
    pose, trail = version(model, belief, paths, normal)
    return belief._replace(pose=pose, trail=trail, alarm=False)


@backend.register("move_pushed")
def _moved(
    model: ReadingModel, belief: PushedPoseBelief, paths: Sequence[Tensor], normal: list[Tensor]
) -> tuple[Tensor, Tensor]:
    for path, drawn in zip(paths, normal, strict=True):
        pushed = _pushed(model.body, belief, path)
        pose = pushed + model.motion.variance(pushed - belief.pose).sqrt() * drawn
        belief = followed(belief._replace(pose=pose))
    return belief.pose, belief.trail


@backend.register("move_pushed", "numba", compiled.supports)
def _moved_numba(
    model: ReadingModel, belief: PushedPoseBelief, paths: Sequence[Tensor], normal: list[Tensor]
) -> tuple[Tensor, Tensor]:
    from rumi.belief.pushed_pose_numba import move as kernel

    if model.arrays is None:
        return _moved(model, belief, paths, normal)
    ends = np.cumsum([0, *(len(path) for path in paths)])
    pose, trail = np.empty(belief.pose.shape), np.empty(belief.trail.shape)
    numbers, drawn = np.array(model.motion), torch.stack(normal).numpy()
    kernel(_held(belief), torch.cat(list(paths)).numpy(), ends, drawn, model.arrays[0], numbers, pose, trail)
    return torch.from_numpy(pose), torch.from_numpy(trail)


def _held(belief: PushedPoseBelief) -> tuple[Any, ...]:
    """A belief as the compiled versions take it: poses, tools, weights, how each slides, and the trail."""
    slides = tuple(part.numpy() for part in belief.sliding if part is not None)
    return belief.pose.numpy(), belief.tool.numpy(), belief.log_weights.numpy(), slides, belief.trail.numpy()


def followed(belief: PushedPoseBelief, mean: Float[Tensor, "3"] | None = None) -> PushedPoseBelief:
    """The same with its mean pose, worked out where it is not given, before those after the last readings."""
    mean = belief.mean() if mean is None else mean
    return belief._replace(trail=torch.cat((mean[None], belief.trail[:-1])))


def _pushed(body: PushedBody, belief: PushedPoseBelief, path: Tensor) -> Tensor:
    """Poses after a path of the tool, by the push model."""
    return push_along_path(
        belief.pose,
        path + belief.tool[:, None],
        body.pusher,
        body.outline,
        belief.sliding,
        substeps=1,
        passes=_PASSES,
        distances=False,
    ).track[:, -1]
