"""Worlds far from their origin, brought near in float64; what float32 makes of them then."""

from functools import partial

import torch
from torch import Tensor

from sdf import backend
from sdf.posed import posed_distance
from sdf.recentred import Recentred
from tests.stress import measures
from tests.stress.draws import directions, log_uniform, poses, uniform
from tests.stress.subjects.distances import VERSIONS, table
from tests.stress.sweep import Inputs, Sweep, register

F64 = torch.float64
SPACING = 0.002


def _draw(generator: torch.Generator) -> Inputs:
    """Poses and points, float64, of a workspace of half a metre that is 1 m to 10 000 km away."""
    origin = directions(generator, 1) * log_uniform(generator, 1, 1, low=1.0, high=1e7)
    at = poses(generator, 24, 0.1)
    at[:, :3, 3] += origin
    return {"poses": at, "points": origin + uniform(generator, 200, 3, low=-0.25, high=0.25)}


def _near(version: str, inputs: Inputs) -> Tensor:
    frame = Recentred.about(inputs["points"])
    with backend.force(version):
        return posed_distance(
            table(SPACING, torch.float32), frame.poses(inputs["poses"]), frame.points(inputs["points"])
        )


def _far(inputs: Inputs) -> Tensor:
    # less one of the points: exact where two numbers are near each other
    origin = inputs["points"][0]
    at = inputs["poses"].clone()
    at[:, :3, 3] -= origin
    return posed_distance(table(SPACING, F64), at, inputs["points"] - origin)


def _there_and_back(inputs: Inputs) -> Tensor:
    frame = Recentred.about(inputs["points"])
    return frame.world_poses(frame.poses(inputs["poses"]))[:, :3, 3]


def _away(inputs: Inputs) -> Tensor:
    return inputs["points"].norm(dim=-1).amax()[None]


def _enter() -> None:
    off = "metres from the origin"
    for version in VERSIONS:
        register(
            Sweep(
                f"far-distances-{version}", _draw, partial(_near, version), _far,
                lambda got, wanted, i: measures.absolute(got, wanted), 1e-5, "m", _away, off,
            )
        )  # fmt: skip
    register(
        Sweep(
            "far-poses-there-and-back", _draw, _there_and_back, lambda i: i["poses"][:, :3, 3],
            lambda got, wanted, i: measures.absolute(got, wanted), 1e-6, "m", _away, off,
        )
    )  # fmt: skip


_enter()
