"""The push model as arrays, for the kernel that carries touched rollouts through one action."""

import math

import torch
from jaxtyping import Bool
from torch import Tensor

from rumi.dynamics.displacement import TIE, DisplacementModel, Touched
from rumi.dynamics.displacement_numba import push_action
from sdf.voxel_grid import VoxelGrid


class FusedPush:
    """The fused CPU version of `push_action` for a planar model.

    Skipped, with the same result: points of discs that reach nothing above the number that decides on contact.

    Args:
        model: whose fields, points and bound are looked up.
    """

    def __init__(self, model: DisplacementModel) -> None:
        probability, normal = model.grids
        centres = model.points.new_zeros(1, 3)
        # without a bound, one disc that may always touch
        bound = VoxelGrid(torch.ones_like(probability.values[:1, :1]), probability.origin, probability.spacing)
        if model.bound is not None:
            centres, bound = model.bound.centres_t, model.bound.grid
        owner = torch.cdist(model.points[:, :2], centres[:, :2]).argmin(-1)
        starts = torch.searchsorted(owner.sort().values, torch.arange(len(centres) + 1))
        order = owner.argsort(stable=True)
        padded = torch.nn.functional.pad(probability.values[:, :, 0], [2, 2, 2, 2])
        tool = (model.points[order], starts, order)
        fields = (padded, normal.values[:, :, 0], probability.origin)
        bounds = (bound.values[:, :, 0], bound.origin, centres)
        self._arrays = tuple(part.contiguous().numpy() for part in (*tool, *fields, *bounds))
        settings = model.settings
        self._scale, self._mini_steps = 1.0 / probability.spacing, settings.mini_steps
        self._push_cosine = math.cos(settings.push_angle)
        self._holds = settings.hazard != "per_mini_step"

    def __call__(self, touched: Touched, count: int, index: int, contact: Bool[Tensor, "R"]) -> int:
        """Action `index` of the first `count` touched rollouts, in place; gives the number of checks."""
        mini = self._mini_steps
        state = (touched.now, touched.way, touched.offset, touched.strayed, touched.stuck)
        first = (touched.start[:count] - index * mini).clamp_min(0)
        draws = touched.draws[:count, index * mini : (index + 1) * mini].contiguous()
        met, checks = torch.zeros(count, dtype=torch.bool), torch.zeros(count, dtype=torch.long)
        push_action(
            *(part[:count].numpy() for part in state),
            *(part.numpy() for part in (first, draws, met, checks)),
            *self._arrays,
            self._scale,
            self._push_cosine,
            TIE,
            self._holds,
        )
        contact[:count] |= met
        return int(checks.sum())
