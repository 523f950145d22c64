"""The push model as arrays, for the kernel that rolls control sequences out."""

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.base import PushRollouts
from rumi.dynamics.displacement import TIE, DisplacementModel
from sdf.voxel_grid import VoxelGrid


class FusedPush:
    """The fused CPU version of `rollout_drawn`, for a tool that moves in a plane or in space.

    Skipped, with the same result: points of discs that cannot hold the greatest contact probability; and all of a
    rollout that has met the same as another of its control sequence so far.

    Args:
        model: whose fields, points and bound are looked up.
    """

    def __init__(self, model: DisplacementModel) -> None:
        probability, normal = model.grids
        self._spatial = model.tool.spatial
        axes = 3 if self._spatial else 2
        centres = model.points.new_zeros(1, 3)
        # without a bound, one disc that may always touch
        bound = VoxelGrid(torch.ones_like(probability.values[:1, :1, :1]), probability.origin, probability.spacing)
        if model.bound is not None:
            centres, bound = model.bound.centres_t, model.bound.grid
        owner = torch.cdist(model.points[:, :axes], centres[:, :axes]).argmin(-1)
        starts = torch.searchsorted(owner.sort().values, torch.arange(len(centres) + 1))
        order = owner.argsort(stable=True)
        values = [
            grid if self._spatial else grid[:, :, 0] for grid in (probability.values, normal.values, bound.values)
        ]
        padded = torch.nn.functional.pad(values[0], [2] * 2 * axes)
        self._body = _arrays(*model.points[order, :axes].unbind(-1), starts, order)
        self._fields = _arrays(padded.flatten(), probability.origin, values[1])
        self._discs = _arrays(values[2], bound.origin, centres)
        (self._action,) = _arrays(model.tool.scale)
        self._arm = model.tool.arm_arrays()
        self._sizes = np.array((*padded.shape, 1.0 / probability.spacing, TIE))
        settings = model.settings
        holds = settings.hazard != "per_mini_step"
        self._rules = np.array((math.cos(settings.push_angle), holds, settings.mini_steps))
        self._mini_steps = settings.mini_steps

    def __call__(
        self, configuration: Float[Tensor, "Q"], controls: Float[Tensor, "K H A"], uniforms: Float[Tensor, "K M H S"]
    ) -> PushRollouts:
        """The rollouts that given uniform numbers lead to."""
        (samples, horizon, _), rollouts = controls.shape, uniforms.shape[1]
        states = controls.new_empty(samples, rollouts, horizon + 1, len(configuration))
        moved = controls.new_empty(samples, rollouts, horizon + 1, 3)
        contact = torch.empty(samples, rollouts, horizon, dtype=torch.bool)
        twin = torch.empty(samples, rollouts, dtype=torch.long)
        checks = torch.zeros(samples, dtype=torch.long)
        if self._spatial:
            from rumi.dynamics.displacement_space_numba import push_rollouts
        else:
            from rumi.dynamics.displacement_numba import push_rollouts
        push_rollouts(
            *_arrays(configuration, controls, uniforms),
            self._action,
            self._body,
            self._fields,
            self._discs,
            self._arm,
            self._sizes,
            self._rules,
            self._scratch(samples, rollouts),
            tuple(part.numpy() for part in (states, moved, contact, twin, checks)),
        )
        whole = samples * rollouts * horizon * self._mini_steps
        return PushRollouts(states, moved, contact, int(checks.sum()) / max(1, whole), twin)

    def _scratch(self, samples: int, rollouts: int) -> tuple[Any, ...]:
        """Room to work in, by control sequence: state, flags and number of each group; bounds; probabilities."""
        return (
            np.zeros((samples, rollouts, 12 if self._spatial else 10)),
            np.zeros((samples, 2, rollouts), np.bool_),
            np.zeros((samples, rollouts), np.int64),
            np.empty((samples, len(self._discs[2]))),
            np.empty((samples, len(self._body[0])), self._fields[0].dtype),
        )


def _arrays(*tensors: Tensor) -> tuple[Any, ...]:
    return tuple(tensor.detach().contiguous().numpy() for tensor in tensors)
