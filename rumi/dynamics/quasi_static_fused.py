"""The quasi-static push model as arrays, for the kernel that rolls control sequences out."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.base import PushRollouts
from rumi.dynamics.quasi_static import QuasiStaticModel, twins
from rumi.dynamics.quasi_static_numba import push_rollouts

_GROUP = 12  # points of the tool's border that one bound settles together


class FusedPush:
    """The fused CPU version of `rollout_poses`.

    Skipped besides, with the same result: groups of the tool's points that are too far from the object to hold the
    deepest of them.

    Args:
        model: whose outline, points and friction are used.
    """

    def __init__(self, model: QuasiStaticModel) -> None:
        self._model = model
        points, outline, sliding = model.points, model.outline, model.sliding
        owner = _groups(points)
        order = owner.argsort(stable=True)
        count = int(owner.max()) + 1
        starts = torch.searchsorted(owner[order], torch.arange(count + 1))
        sets = [points[owner == index] for index in range(count)]
        centres = torch.stack([0.5 * (own.amin(0) + own.amax(0)) for own in sets])
        radii = torch.stack([(own - centre).norm(dim=-1).max() for own, centre in zip(sets, centres, strict=True)])
        self._body = _arrays(*points[order].unbind(-1), order, starts, centres.double(), radii.double())
        self._outline = _arrays(outline.values, outline.values.flatten(), outline.origin.double())
        width = float(points.norm(dim=-1).max())
        numbers = (
            outline.spacing,
            model.reach,
            width,
            *sliding.centre.tolist(),
            float(sliding.lever),
            float(sliding.friction),
        )
        self._numbers = np.array(numbers)
        self._counts = np.array((model.settings.mini_steps, model.settings.passes))

    def __call__(
        self, configuration: Float[Tensor, "3"], controls: Float[Tensor, "K H A"], poses: Float[Tensor, "M 3"]
    ) -> PushRollouts:
        """The rollouts in which the object starts at given poses."""
        (samples, horizon, _), rollouts = controls.shape, len(poses)
        path = configuration.expand(samples, horizon + 1, 3).contiguous()
        track = path.new_empty(samples, rollouts, horizon + 1, 3)
        contact = torch.zeros(samples, rollouts, horizon, dtype=torch.bool)
        checks = torch.zeros(samples, dtype=torch.long)
        push_rollouts(
            *_arrays(controls, self._model.tool.scale),
            self._model.tool.arm_arrays(),
            *_arrays(path, poses.to(path)),
            self._body,
            self._outline,
            self._numbers,
            self._counts,
            np.empty((samples, len(self._body[0])), self._body[0].dtype),
            tuple(part.numpy() for part in (track, contact, checks)),
        )
        shifts, turns = self._model.motions(
            poses.to(path).repeat(samples, 1), track.view(samples * rollouts, horizon + 1, 3)
        )
        whole = samples * rollouts * horizon * self._model.settings.mini_steps
        return PushRollouts(
            path[:, None].expand(track.shape).contiguous(),
            shifts.view(track.shape),
            contact,
            int(checks.sum()) / max(1, whole),
            twins(contact),
            turns.view(track.shape[:3]),
            self._model.pivot,
        )


def _groups(points: Float[Tensor, "n 2"]) -> Tensor:
    """Number of the group of each point: near ones together."""
    count = max(1, len(points) // _GROUP)
    centres = points[:1]
    while len(centres) < count:
        centres = torch.cat((centres, points[torch.cdist(points, centres).amin(-1).argmax()][None]))
    return torch.unique(torch.cdist(points, centres).argmin(-1), return_inverse=True)[1]


def _arrays(*tensors: Tensor) -> tuple[Any, ...]:
    return tuple(tensor.detach().contiguous().numpy() for tensor in tensors)
