"""Real pushes of planar objects (the MIT push set): readers, and scores of what models predict of them.

`RUMI_DATA/real_pushes` is read: Yu, Bauza, Fazeli, Rodriguez, More than a Million Ways to Be Pushed (IROS 2016), as
kept in github.com/robinzhoucmu/Pushing; `closed_loop.npz` is of github.com/mcubelab/cpush.
"""

import json
import math
import os
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.along_path import Pusher
from rumi.dynamics.outline import GridOutline, Support
from rumi.dynamics.push_density import PushPrediction
from rumi.dynamics.push_parameters import sliding_of
from rumi.dynamics.push_posterior import PushPosterior
from rumi.dynamics.pushed_body import ObservedPush, PushedBody
from rumi.dynamics.sliding import rotated
from rumi.errors import UsageError
from sdf.so3 import wrap

TIP_M = 0.00475
_INSTANTS = 21  # of a path of 50 mm

SHAPES = ("rect1", "rect3", "tri1", "tri2", "ellip1", "ellip2", "hex")
SURFACES = ("abs", "plywood")
SETS = tuple(f"{surface} {shape}" for surface in SURFACES for shape in SHAPES)


class PushSet(NamedTuple):
    """Pushes of one object on one surface.

    Attributes:
        body: the object and the tip.
        start: (n, 3), poses before, metres and radians.
        path: (n, K1, 3), of the tip.
        end: (n, 3), poses after.
        zhou: (n, 3), as Zhou et al. predict them with a 4th-order limit surface.
    """

    body: PushedBody
    start: Float[Tensor, "n 3"]
    path: Float[Tensor, "n K1 3"]
    end: Float[Tensor, "n 3"]
    zhou: Float[Tensor, "n 3"]

    def observed(self, rows: Tensor) -> list[ObservedPush]:
        """Some of the pushes, to learn from."""
        return [ObservedPush(self.start[i], self.path[i], self.end[i]) for i in rows.tolist()]


class Scores(NamedTuple):
    """Errors of predicted pushes, one a push.

    Attributes:
        place_mm: of the position.
        turn_deg: of the yaw.
        along_mm: signed, along the tip's way.
        across_mm: signed, across it.
    """

    place_mm: Tensor
    turn_deg: Tensor
    along_mm: Tensor
    across_mm: Tensor


def folder() -> Path:
    """Where the data is.

    Raises:
        UsageError: it is nowhere.
    """
    found = Path(os.environ.get("RUMI_DATA", "")) / "real_pushes"
    if not os.environ.get("RUMI_DATA") or not found.is_dir():
        raise UsageError("Expected the folder of recorded data in RUMI_DATA, with real_pushes in it")
    return found


@cache
def body_of(shape: str) -> PushedBody:
    """A shape of even density and pressure, and the round tip."""
    corners = torch.tensor(json.loads((folder() / "mit_shapes.json").read_text())[shape], dtype=torch.float64)
    return polygon_body(corners, TIP_M)


def polygon_body(corners: Float[Tensor, "m 2"], tip_m: float, *, spacing: float = 0.001) -> PushedBody:
    """A flat object of a polygon's outline, and a round tip."""
    low, high = corners.amin(0) - 0.012, corners.amax(0) + 0.012
    counts = torch.ceil((high - low) / spacing).long() + 1
    axes = [low[i] + spacing * torch.arange(int(counts[i]), dtype=low.dtype) for i in range(2)]
    nodes = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    values = polygon_distance(nodes, corners)
    base = nodes[values <= 0]
    outline = GridOutline(values, low, spacing, float(corners.norm(dim=-1).max()) + spacing)
    return PushedBody(outline, Support.of_base(base, base.mean(0)), Pusher.disc(tip_m, base))


def polygon_distance(points: Float[Tensor, "*b 2"], corners: Float[Tensor, "m 2"]) -> Float[Tensor, "*b"]:
    """Signed distance from a polygon, negative inside."""
    sides = corners.roll(-1, 0) - corners
    off = points[..., None, :] - corners
    along = ((off * sides).sum(-1) / sides.square().sum(-1)).clamp(0.0, 1.0)
    distance = (off - along[..., None] * sides).norm(dim=-1).amin(-1)
    x, y = off.unbind(-1)
    over = (y < 0) != (y < sides[:, 1])
    left = x < sides[:, 0] * y / torch.where(sides[:, 1] == 0, torch.ones_like(sides[:, 1]), sides[:, 1])
    inside = (over & left).sum(-1) % 2 == 1
    return torch.where(inside, -distance, distance)


@cache
def push_set(name: str, speed: int = 10) -> PushSet:
    """The set of a surface and a shape, such as "abs rect1", at a speed in mm/s."""
    surface, shape = name.split()
    with np.load(folder() / "mit_pushes.npz") as data:
        rows = torch.tensor(data[f"{surface}__{shape}__v{speed}"])
    share = torch.linspace(0.0, 1.0, _INSTANTS, dtype=rows.dtype)[:, None]
    place = rows[:, None, 6:8] + share * (rows[:, 8:10] - rows[:, 6:8])[:, None]
    path = torch.cat((place, torch.zeros_like(place[..., :1])), -1)
    return PushSet(body_of(shape), rows[:, :3].contiguous(), path, rows[:, 3:6].contiguous(), rows[:, 10:13])


def scores(predicted: Float[Tensor, "n 3"], end: Float[Tensor, "n 3"], path: Float[Tensor, "n K1 3"]) -> Scores:
    """Errors of predicted ends."""
    off = 1e3 * (predicted - end)[:, :2]
    way = path[:, -1] - path[:, 0]
    along, across = rotated(off, -torch.atan2(way[:, 1], way[:, 0])).unbind(-1)
    turn = wrap(predicted[:, 2] - end[:, 2]).abs() * 180.0 / math.pi
    return Scores(off.norm(dim=-1), turn, along, across)


def fixed(friction: float, lever_ratio: float) -> PushPosterior:
    """One particle: an ellipsoid with given numbers."""
    one = PushPosterior.prior(1)
    numbers = torch.tensor([[math.log(friction), math.log(lever_ratio), *[0.0] * 6]], dtype=torch.float64)
    return PushPosterior(numbers, one.log_weights)


def predicted(posterior: PushPosterior, own: PushSet, rows: Tensor) -> PushPrediction:
    """Of some pushes of a set."""
    return posterior.predict(own.start[rows], own.path[rows], own.body)


@cache
def repeated_bound() -> list[tuple[str, float, float]]:
    """For each plan of two-finger pushes, repeated from nearly one start: how far ends are off their mean.

    Of those of one plan, runs that start within 1 mm of one another are compared; drop-outs, at (0, 0), are left out.
    """
    found = []
    for plan in sorted((folder() / "repeated").iterdir()):
        ends, starts = [], []
        for file in sorted(plan.glob("*.txt")):
            rows = np.loadtxt(file, delimiter=",")
            rows = rows[np.abs(rows[:, 1:3]).sum(1) > 0]
            starts.append(rows[:10, 1:4].mean(0))
            ends.append(rows[-10:, 1:4].mean(0))
        start, end = np.array(starts), np.array(ends)
        near = np.hypot(*(start - np.median(start, 0))[:, :2].T) < 1.0
        if near.sum() < 2:
            continue
        off = end[near] - end[near].mean(0)
        off[:, 2] = (end[near, 2] - end[near, 2][0] + math.pi) % (2 * math.pi)
        off[:, 2] -= off[:, 2].mean()
        spread = near.sum() / (near.sum() - 1)
        place, turn = np.hypot(*off[:, :2].T), np.degrees(np.abs(off[:, 2]))
        found.append((plan.name, float(place.mean() * spread**0.5), float(turn.mean() * spread**0.5)))
    return found


class WrenchTwists(NamedTuple):
    """Measured wrenches and the twists that they led to, object frame.

    Attributes:
        wrench: (n, 3), force and moment over a length, N.
        twist: (n, 3), velocity and rate of turn times the length.
        length_m: the unit of moments, which is not stated: the greatest distance of the outline from its origin is what
            agrees with the pushes (not for tri2, which is left out).
    """

    wrench: Float[Tensor, "n 3"]
    twist: Float[Tensor, "n 3"]
    length_m: float


@cache
def wrench_twists(name: str) -> WrenchTwists:
    """Those of a set, such as "abs rect1"."""
    with np.load(folder() / "mit_wrench_twist.npz") as data:
        key = name.replace(" ", "_") + "_quadratic_v10__"
        wrench, twist = torch.tensor(data[key + "wrench"]), torch.tensor(data[key + "twist"])
    return WrenchTwists(wrench, twist, body_of(name.split()[1]).outline.radius - 0.001)


def wrench_log_likelihood(
    parameters: Float[Tensor, "N 8"], rows: Tensor, own: WrenchTwists, body: PushedBody, *, scale: float = 0.2
) -> Float[Tensor, "N"]:
    """Of the directions of some twists, given the wrenches: normals of the limit surface, with a heavy-tailed error.

    Args:
        parameters: of particles.
        rows: pairs that are known.
        own: the pairs.
        body: the object.
        scale: of the error of the direction, radians (10 degrees is the median of the sets' own quadratic fits).
    """
    sliding = sliding_of(parameters, body.support)
    assert sliding.quartic is not None
    # moments about the centre of friction, in units of the lever
    force, moment = own.wrench[rows, None, :2], own.wrench[rows, None, 2] * own.length_m
    moment = (moment - sliding.centre[:, 0] * force[..., 1] + sliding.centre[:, 1] * force[..., 0]) / sliding.lever
    first, second, mean, level, slant = sliding.quartic.unbind(-1)
    size = torch.hypot(first, second).clamp_min(1e-9)
    stretch = size.sinh() / size
    fx, fy = force.unbind(-1)
    ax = (size.cosh() + stretch * first) * fx + stretch * second * fy
    ay = stretch * second * fx + (size.cosh() - stretch * first) * fy
    bx, by = (mean + level) * fx + slant * fy, slant * fx + (mean - level) * fy
    whole, half = ax * fx + ay * fy + moment.square(), 0.5 * moment.square()
    turn = (whole + 0.5 * (bx * fx + by * fy)) * moment / sliding.lever
    place = torch.stack((whole * ax + half * bx, whole * ay + half * by), -1)
    # of the body's origin, as measured
    arm = -sliding.centre
    place = place + turn[..., None] * torch.stack((-arm[:, 1], arm[:, 0]), -1)
    shown = torch.cat((place, body.support.spread * turn[..., None]), -1)
    ratio = body.support.spread / own.length_m
    true = torch.cat((own.twist[rows, :2], ratio * own.twist[rows, 2:]), -1)[:, None]
    cosine = torch.nn.functional.cosine_similarity(shown, true, dim=-1).clamp(-1.0, 1.0)
    return -2.0 * torch.log1p((cosine.arccos() / scale).square() / 2.0).sum(0)


@cache
def long_pushes(way_m: float = 0.3, instants: int = 151) -> list[tuple[str, ObservedPush]]:
    """Stretches of `closed_loop` without knocks, cut to a length of the tip's way.

    The square of 90 mm and the tip touch all along (within 2 mm), and neither jumps by more than 0.6 mm in a
    millisecond.
    """
    found = []
    with np.load(folder() / "closed_loop.npz") as data:
        runs = {name: data[name] for name in data}
    for name, rows in runs.items():
        gap = np.maximum(np.abs(_in_body(rows)) - 0.045, 0.0)
        apart = np.hypot(*gap.T) - TIP_M
        jump = np.abs(np.diff(rows[:, 1:], axis=0, prepend=rows[:1, 1:]))[:, [0, 1, 3, 4]].max(1)
        good = (np.abs(apart) < 2e-3) & (jump < 6e-4)
        begin = 0
        while begin < len(rows):
            if not good[begin]:
                begin += 1
                continue
            bad = np.flatnonzero(~good[begin:])
            end = begin + int(bad[0]) if len(bad) else len(rows)
            way = np.cumsum(np.hypot(*np.diff(rows[begin:end, 4:6], axis=0).T))
            last = int(np.searchsorted(way, way_m))
            if last < len(way):
                at = np.searchsorted(way, np.linspace(0.0, way_m, instants)).clip(0, last)
                tip = torch.tensor(rows[begin + at, 4:6])
                path = torch.cat((tip, torch.zeros_like(tip[:, :1])), -1)
                poses = torch.tensor(rows[[begin, begin + last], 1:4])
                found.append((name, ObservedPush(poses[0], path, poses[1])))
                begin += last
            else:
                begin = end
    return found


def _in_body(rows: np.ndarray) -> np.ndarray:
    off, yaw = rows[:, 4:6] - rows[:, 1:3], rows[:, 3]
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.stack((cos * off[:, 0] + sin * off[:, 1], cos * off[:, 1] - sin * off[:, 0]), -1)


def square_body() -> PushedBody:
    """The square of 90 mm and the tip of `closed_loop`."""
    corners = torch.tensor([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]], dtype=torch.float64)
    return polygon_body(0.045 * corners, TIP_M)
