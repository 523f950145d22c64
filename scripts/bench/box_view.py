"""A box of which one patch is seen, in SE(3): several faces fit, each at a range of places and turns."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.seeding import split
from scripts.bench.chains import LogDensity
from sdf.object_model import ObjectModel, box_model
from sdf.posed import posed_distance
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics

HALF_EXTENTS = (0.030, 0.045, 0.065)
_PATCH_M = 0.024  # half the edge of the seen patch: smaller than every face


class BoxView(NamedTuple):
    """The scene.

    Attributes:
        model: the box, float64, its largest face up where it stands truly, at the origin.
        observation: surface points of a square patch at z = 0 and free points above it, float64.
        low, high: box of places that holds all plausible origins, metres.
    """

    model: ObjectModel
    observation: Observation
    low: Float[Tensor, "3"]
    high: Float[Tensor, "3"]


def box_view(surface: int = 80, free: int = 160) -> BoxView:
    """A patch of the box's top that a camera above it sees through a gap, noise-free; the top is at z = 0."""
    model = box_model(HALF_EXTENTS).to(torch.float64)
    noise = split(0, "box view")
    patch = _PATCH_M * (2 * torch.rand(surface, 2, generator=noise, dtype=torch.float64) - 1)
    seen = torch.cat((patch, torch.zeros(surface, 1, dtype=torch.float64)), -1)
    share = torch.rand(free, 3, generator=noise, dtype=torch.float64)
    above = torch.cat((2.0 * _PATCH_M * (2 * share[:, :2] - 1), 0.004 + 0.1 * share[:, 2:]), -1)
    observation = concatenate([Observation.of(seen, Semantics.SURFACE), Observation.of(above, Semantics.FREE)])
    low = torch.tensor((-0.09, -0.09, -0.09), dtype=torch.float64)
    high = torch.tensor((0.09, 0.09, 0.0), dtype=torch.float64)
    return BoxView(model, observation, low, high)


def box_density(
    view: BoxView, *, peakiness: float = 2.0, free_scale: float = 80.0, tolerance: float = 0.001
) -> LogDensity:
    """-lambda C^ of poses from exact distances (RUMI, Eqs 3-6 and 10)."""
    cost = Discrepancy(view.model.exact, view.model.radius, free_scale=free_scale, tolerance=tolerance).double()

    def log_density(poses: Float[Tensor, "N 4 4"]) -> Float[Tensor, "N"]:
        return -peakiness * cost(poses, view.observation)

    return log_density


def face_up(poses: Float[Tensor, "*b 4 4"]) -> Tensor:
    """Which pair of faces looks up most, 0 to 2: those across the box's x, y or z."""
    return poses[..., 2, :3].abs().argmax(-1)


def field_points(count: int = 800) -> Float[Tensor, "count 3"]:
    """Random points in and about where the box may be."""
    share = torch.rand(count, 3, generator=split(0, "field points"), dtype=torch.float64)
    return torch.tensor((-0.12, -0.12, -0.16)) + share * torch.tensor((0.24, 0.24, 0.18), dtype=torch.float64)


def surface_error(view: BoxView, poses: Float[Tensor, "N 4 4"]) -> Float[Tensor, "N"]:
    """Mean distance of the seen points from the box at each pose, metres."""
    seen = view.observation.points[view.observation.of_class(Semantics.SURFACE)]
    return posed_distance(view.model.exact, poses, seen).abs().mean(-1)
