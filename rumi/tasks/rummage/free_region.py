"""Regions in which a simulated task reports free points."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.sim.settings import SimSettings
from rumi.tasks.rummage.scene_spec import TaskSpec
from sdf.object_model import ObjectModel
from sensors.observation import Observation
from sensors.semantics import Semantics

# standard deviations of the prior up to which free points are reported
_SPREADS = 4.0


def region_of_prior(spec: TaskSpec, model: ObjectModel) -> Float[Tensor, "2 3"]:
    """The box that holds the object wherever it may well be.

    Raises:
        UsageError: the task has no prior.
    """
    prior, bounds = spec.prior, model.exact.bounds.float()
    if prior is None:
        raise UsageError(f"Expected {spec.name} to have a camera or a prior, got neither")
    mean, reach = torch.tensor(prior.mean_m), _SPREADS * prior.spread_m + model.radius
    top = max(float((bounds[1] - bounds[0])["xyz".index(up)]) for up in spec.up)
    return torch.tensor([[*(mean - reach).tolist(), 0.0], [*(mean + reach).tolist(), top]])


def region_unseen(spec: TaskSpec, model: ObjectModel) -> Float[Tensor, "2 3"]:
    """Where the object may be if the first view does not show it: nowhere in particular without a prior."""
    return torch.zeros(2, 3) if spec.prior is None else region_of_prior(spec, model)


def region_about(surface: Float[Tensor, "M 3"], spec: TaskSpec, settings: SimSettings) -> Float[Tensor, "2 3"]:
    """The box in which free points can refute a pose that the view leaves open."""
    grow = settings.free_region_m
    low, high = surface.amin(0) - grow, surface.amax(0) + grow
    if spec.search == "SE(2)":
        # an upright object is no taller than what is seen of it
        high[2] -= grow
        high[2] = math.ceil(float(high[2]) / settings.free_spacing_m) * settings.free_spacing_m
    low[2] = 0.0
    return torch.stack((low, high))


def floor_points(region: Float[Tensor, "2 3"], spec: TaskSpec) -> Observation:
    """Free points where the floor is, fixed in the world (RUMI, V.B)."""
    step = spec.field_spacing_m
    low, high = region[:, :2]
    ends = [(float(low[axis]), float(high[axis]) + 0.5 * step) for axis in (0, 1)]
    x, y = (torch.arange(*pair, step, dtype=torch.float32) for pair in ends)
    points = torch.stack(torch.meshgrid(x, y, x.new_zeros(1), indexing="ij"), -1).reshape(-1, 3)
    return Observation.of(points, Semantics.FREE, attached=False)
