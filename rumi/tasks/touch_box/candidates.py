"""Candidate pokes: splines through via-points, with clamped ends, that go into the belief (touch-only paper, IV.C)."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.along_path import Pusher, distance_to
from rumi.dynamics.sliding import Outline, rotated
from rumi.resampling import resample_systematic

_FINE = 8  # points of a spline for each part of the path that is read off it
_TRIES = 4  # starts that are drawn for a poke, of which the freest is taken
_CLEAR_M = 0.005
_WITNESSES = 100  # equal shares of the belief by which that is judged


def clamped_spline(via: Float[Tensor, "*b V D"], phase: Float[Tensor, "T"]) -> Float[Tensor, "*b T D"]:
    """Cubic spline through via-points, spread evenly over the phase [0, 1], at rest at both ends (App C).

    Args:
        via: (*b, V, D), the start first; V >= 2.
        phase: (T), in [0, 1].
    """
    count = via.shape[-2] - 1
    slopes = torch.zeros_like(via)
    if count > 1:  # equal second derivatives from both sides at the inner points, no slope at the ends
        matrix = torch.eye(count - 1, dtype=via.dtype, device=via.device) * 4.0
        beside = torch.ones(max(0, count - 2), dtype=via.dtype, device=via.device)
        matrix = matrix + torch.diag(beside, 1) + torch.diag(beside, -1)
        slopes[..., 1:-1, :] = torch.linalg.solve(matrix, 3.0 * (via[..., 2:, :] - via[..., :-2, :]))
    place = (phase * count).clamp(0.0, float(count))
    piece = place.long().clamp_max(count - 1)
    s = (place - piece)[:, None]
    before, after = via[..., piece, :], via[..., piece + 1, :]
    out, into = slopes[..., piece, :], slopes[..., piece + 1, :]
    square, cube = s * s, s * s * s
    value = (2.0 * cube - 3.0 * square + 1.0) * before + (3.0 * square - 2.0 * cube) * after
    return value + (cube - 2.0 * square + s) * out + (cube - square) * into


def evenly(line: Float[Tensor, "*b T 2"], count: int) -> Float[Tensor, "*b M 2"]:
    """`count` points on a fine polyline, evenly spaced along its length, its ends among them."""
    steps = (line[..., 1:, :] - line[..., :-1, :]).norm(dim=-1)
    along = torch.cat((torch.zeros_like(steps[..., :1]), steps.cumsum(-1)), -1)
    share = torch.linspace(0.0, 1.0, count, dtype=line.dtype, device=line.device)
    wanted = along[..., -1:] * share
    index = torch.searchsorted(along, wanted.contiguous(), right=True).clamp(1, along.shape[-1] - 1)
    low, high = along.gather(-1, index - 1), along.gather(-1, index)
    part = ((wanted - low) / (high - low).clamp_min(1e-12)).clamp(0.0, 1.0)[..., None]
    wide = index[..., None].expand(*index.shape, 2)
    begin, end = line.gather(-2, wide - 1), line.gather(-2, wide)
    return begin + part * (end - begin)


def pokes(
    poses: Float[Tensor, "N 3"],
    log_weights: Float[Tensor, "N"],
    outline: Outline,
    half: tuple[float, float],
    pusher: Pusher,
    count: int,
    *,
    length_m: float,
    readings: int,
    bend: float,
    generator: torch.Generator,
) -> Float[Tensor, "C K1 3"]:
    """Pokes into the belief: each ends at a point in the volume of a particle that is drawn by weight.

    They come from any side, bend by a via-point in the middle, and begin where the belief has least weight in the way
    of a tool that comes down there. The tool looks the way the poke goes.

    Args:
        poses: (x, y, yaw) of the particles.
        log_weights: of the particles.
        outline: of the object.
        half: half of its sides, metres, within which a poke ends.
        pusher: the tool.
        count: of candidates.
        length_m: from start to end, straight.
        readings: parts of a path.
        bend: standard deviation of the via-point's place aside, as a share of the length.
        generator: all randomness.
    """
    like = poses

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator, dtype=like.dtype)

    drawn = poses[resample_systematic(log_weights, generator=generator)]
    chosen = drawn[torch.randint(len(poses), (count,), generator=generator)]
    inside = (2.0 * uniform(count, 2) - 1.0) * like.new_tensor(half)
    end = chosen[:, :2] + rotated(inside, chosen[:, 2])
    angle = 2.0 * math.pi * uniform(count, _TRIES)
    away = torch.stack((angle.cos(), angle.sin()), -1)
    start = end[:, None] - length_m * away
    # how much of the belief stands where the tool would come down
    tool = torch.cat((start, angle[..., None]), -1).reshape(-1, 3)
    share = drawn[torch.linspace(0, len(poses) - 1, min(_WITNESSES, len(poses))).round().long()]
    apart = distance_to(share.repeat(len(tool), 1), tool.repeat_interleave(len(share), 0), pusher, outline)
    in_way = (apart.view(count, _TRIES, -1) < _CLEAR_M).to(like.dtype).mean(-1)
    freest = in_way.argmin(-1)
    row = torch.arange(count)
    start, angle, away = start[row, freest], angle[row, freest], away[row, freest]
    aside = torch.stack((-away[:, 1], away[:, 0]), -1)
    shift = bend * length_m * torch.randn(count, 1, generator=generator, dtype=like.dtype)
    via = torch.stack((start, 0.5 * (start + end) + shift * aside, end), 1)
    fine = torch.linspace(0.0, 1.0, _FINE * readings + 1, dtype=like.dtype)
    line = evenly(clamped_spline(via, fine), readings + 1)
    return torch.cat((line, angle[:, None, None].expand(count, readings + 1, 1)), -1)
