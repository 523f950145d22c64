"""Reading of a robot's sensors during one action."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sdf.check import check_finite, is_eager
from sdf.containers import Ragged, container
from sensors.observation import Observation

FORCE = "tool_force"
"""Name of the measurements (*b, K, 3) of a wrist: mean force on the tool on the way to each instant, N, world axes."""

TORQUE_CONTACT = "torque_contact"
"""Name of the measurements (*b, K, 1) of an arm's joints: 1 where their torques tell of a contact, else 0."""

# of a reading padded in its instants the last one counts on
RAGGED = {
    "instant": Ragged(-1),
    "tool_pose": Ragged(-3, None),
    "in_contact": Ragged(-1),
    "object_motion": Ragged(-3, None),
    "measurements": Ragged(0, math.nan, behind=("tool_pose", 3)),  # what follows the instants is the sensor's
}
"""Axes of a reading along which readings differ, by field."""


@container(RAGGED, data=("stamp",))
@dataclass(frozen=True)
class Reading:
    """Everything sensed during one action, at K instants (K >= 1); metres, radians, seconds.

    Points are in the world frame, each at its own instant: while the object moves, a point that rides with
    it must be carried to the object-attached frame by the motion up to that instant.

    Attributes:
        observation: points with semantics, world frame; `attached` tells which ride with the object.
        instant: (*b, M), index 0..K-1 of the instant at which each point was seen.
        tool_pose: (*b, K, 4, 4), world_T_tool at each instant.
        in_contact: (*b, K), whether the tactile sensor touched the object.
        object_motion: (*b, K, 4, 4) or None, measured world motion of the object from the start of the
            action up to each instant (`pose_k = object_motion_k @ pose_start`).
        configuration: (*b, Q), the tool's configuration at the last instant (planar: x, y, yaw).
        clipped: (*b), metres of the commanded translation that the arm's reach refused.
        stamp: seconds since the start of the run; of a batch a tensor (*b).
        measurements: (*b, K, ...) numbers of further sensors at each instant, by sensor; NaN where it gave none.

    Raises:
        ValueError: a value that is not finite, or a point of an instant that there is none of.
    """

    observation: Observation
    instant: Int[Tensor, "*b M"]
    tool_pose: Float[Tensor, "*b K 4 4"]
    in_contact: Bool[Tensor, "*b K"]
    object_motion: Float[Tensor, "*b K 4 4"] | None
    configuration: Float[Tensor, "*b Q"]
    clipped: Float[Tensor, "*b"]
    stamp: float | Float[Tensor, "*b"] = 0.0
    measurements: Mapping[str, Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse what no sensor can mean: a belief that has taken in a NaN is lost."""
        observation, instants = self.observation, self.tool_pose.shape[-3]
        check_finite("observation.points", observation.points.masked_fill(~observation.valid[..., None], 0.0))
        for name in ("tool_pose", "object_motion", "configuration", "clipped"):
            value = getattr(self, name)
            if value is not None:
                check_finite(name, value)
        if not isinstance(self.stamp, Tensor):
            if not math.isfinite(self.stamp):
                raise ValueError(f"Expected stamp to be finite seconds, got {self.stamp}")
        else:
            check_finite("stamp", self.stamp)
        for name, values in self.measurements.items():
            own = values.shape[self.tool_pose.ndim - 3]
            if own != instants:
                raise ValueError(f"Expected {instants} measurements of {name!r}, one an instant, got {own}")
        wrong = observation.valid & ((self.instant < 0) | (self.instant >= instants))
        if is_eager() and bool(wrong.any()):
            raise ValueError(
                f"Expected instant to be 0 to {instants - 1}, the instants of tool_pose, "
                f"got {int(self.instant[wrong][0])}"
            )

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Self:
        """On another device, its floating numbers in another dtype."""
        return replace(self, **{part.name: transfer(getattr(self, part.name), device, dtype) for part in fields(self)})


def transfer(value: Any, device: torch.device | str | None, dtype: torch.dtype | None) -> Any:  # noqa: ANN401
    """A tensor, or all tensors of a mapping or a dataclass, on another device or in a dtype; other values unchanged."""
    if isinstance(value, Tensor):
        return value.to(device=device, dtype=dtype if value.is_floating_point() else None)
    if isinstance(value, Mapping):
        return {name: transfer(part, device, dtype) for name, part in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        parts = {part.name: getattr(value, part.name) for part in fields(value)}
        return replace(value, **{name: transfer(part, device, dtype) for name, part in parts.items()})
    return value
