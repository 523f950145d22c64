"""Rejuvenation of resampled poses by Metropolis moves, with the score of the whole posterior (resample-move)."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.belief.scene_rows import bare, generators_of, put_rows
from rumi.seeding import Generators, normal, uniform
from sdf import se3, so3
from sdf.containers import index
from sensors.evidence import Evidence

LogPrior = Callable[[Tensor], Tensor]
"""Log-density (*b, N) of x, y and yaw (*b, N, 3), up to a constant; `PlanarPrior.log_density` is one."""

_CROSSED = 0.6  # share of the moves that go along the difference of two other particles


def rejuvenate(
    belief: PoseBelief,
    evidence: Sequence[Evidence],
    log_prior: LogPrior,
    *,
    rows: Bool[Tensor, "*b"],
    generator: Generators,
    moves: int = 4,
    jitter_m: tuple[float, float] = (1e-3, 0.02),
    lever_m: float = 0.05,
) -> PoseBelief:
    """Move poses in the plane by Metropolis's rule under all evidence so far (resample-move, Gilks and Berzuini 2001).

    A resampling leaves copies, and of poses that stay where they were drawn a few carry a sharp posterior: the log
    evidence comes out low, the lower the sharper a sensor is, so that what is learnt by it comes out blunt. Moves leave
    the posterior as it is and part the copies.

    Gradients: poses have none, and weights that of the log of evidence and prior where the poses are now, which is what
    the score of a posterior's expectation asks for; whether a move was taken has none.

    Args:
        belief: of one scene or of a batch.
        evidence: all of it so far, in the frame that rides with the object; of a batch containers (`sdf.containers`)
            whose tensors have the scenes in front.
        log_prior: of x, y and yaw in that frame.
        rows: scenes that are moved, those that were just resampled.
        generator: of the draws; a sequence has one a scene.
        moves: of each half of the particles; a half stands still while the other moves along its differences.
        jitter_m: least and greatest standard deviation of moves that know nothing of the others, log-uniform.
        lever_m: by which metres of them are radians of yaw, half of about the object's width.
    """
    if rows.ndim > 1 or rows.shape != belief.log_weights.shape[:-1]:
        raise ValueError(
            f"Expected rows of one scene, or of a batch (B), {tuple(belief.log_weights.shape[:-1])}, "
            f"got {tuple(rows.shape)}"
        )
    if not bool(rows.any()):
        return belief
    some, own = belief, generator
    if rows.ndim:
        some, own = index(bare(belief), rows), generators_of(generator, rows)
        evidence = [index(one, rows) for one in evidence]

    def log_target(poses: Float[Tensor, "*b N 4 4"]) -> Float[Tensor, "*b N"]:
        total = log_prior(se3.to_planar(poses))
        for one in evidence:
            total = total + one.log_likelihood(poses)
        return total

    with torch.no_grad():
        step = partial(_steps, generator=own, jitter_m=jitter_m, lever_m=lever_m)
        poses = _moved(some.attached_T_object.detach(), log_target, step, moves, own)
    score = log_target(poses)
    log = (some.log_weights.detach() + (score - score.detach())).log_softmax(-1)
    moved = replace(some, attached_T_object=poses, log_weights=log)
    return put_rows(belief, rows, moved) if rows.ndim else moved


def _moved(
    poses: Float[Tensor, "*b N 4 4"],
    log_target: Callable[[Tensor], Tensor],
    steps: Callable[[Tensor, Tensor], Tensor],
    moves: int,
    generator: Generators,
) -> Float[Tensor, "*b N 4 4"]:
    poses, target = poses.clone(), log_target(poses)
    for half in ((0, 1) if poses.shape[-3] > 1 else (0,)) * moves:
        now, others = poses[..., half::2, :, :], poses[..., 1 - half :: 2, :, :]
        step = se3.from_planar(steps(now, others))
        proposed = se3.make(step[..., :3, :3] @ now[..., :3, :3], step[..., :3, 3] + now[..., :3, 3])
        there, before = log_target(proposed), target[..., half::2]
        chance = uniform(there.shape, generator=generator, dtype=there.dtype, device=there.device)
        accept = chance.log() < there - before
        poses[..., half::2, :, :] = torch.where(accept[..., None, None], proposed, now)
        target[..., half::2] = torch.where(accept, there, before)
    return poses


def _steps(
    now: Float[Tensor, "*b N 4 4"],
    others: Float[Tensor, "*b M 4 4"],
    *,
    generator: Generators,
    jitter_m: tuple[float, float],
    lever_m: float,
) -> Float[Tensor, "*b N 3"]:
    """Steps in x, y and yaw as likely as their opposites: jitter of any size, or differences of other particles."""
    shape = now.shape[:-2]
    even = partial(uniform, generator=generator, dtype=now.dtype, device=now.device)
    noisy = partial(normal, generator=generator, dtype=now.dtype, device=now.device)
    units = now.new_tensor([1.0, 1.0, 1.0 / lever_m])
    low, high = (math.log(bound) for bound in jitter_m)
    jitter = (low + (high - low) * even((*shape, 1))).exp() * units * noisy((*shape, 3))
    count = others.shape[-3]
    if count < 2:
        return jitter
    planar = se3.to_planar(others)
    picked = (even((*shape, 2)) * count).long().clamp_max(count - 1)
    a, b = (planar.take_along_dim(picked[..., k, None], -2) for k in (0, 1))
    apart = a - b
    apart[..., 2] = so3.wrap(apart[..., 2])
    # a hair's breadth more, so that copies of one particle part too
    across = even((*shape, 1)) * apart + jitter_m[0] * units * noisy((*shape, 3))
    return torch.where(even((*shape, 1)) < _CROSSED, across, jitter)
