"""Motion model: how far an object moved, measured, sticking, pushed, estimated, corrected, or each particle's own."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.dynamics.base import ObjectMotion
from rumi.errors import UsageError
from rumi.registration.descent import DescentSettings, Search, descend
from sdf import se3
from sensors.discrepancy import Discrepancy
from sensors.observation import attach
from sensors.reading import Reading

Motion = Literal["auto", "measured", "sticking", "pushed", "estimated", "corrected", "trajectory"]
MOTIONS: tuple[str, ...] = get_args(Motion)[1:]
"""Of a filter; tasks choose what "auto" is."""

Predictor = Callable[[PoseBelief, Reading], Tensor]
"""World motion (*b, K, 4, 4) that a push model makes of a belief and the tool's path."""


def slip_motion(
    tool_pose: Float[Tensor, "*b K 4 4"],
    in_contact: Bool[Tensor, "*b K"],
    slip: Float[Tensor, "*b K 4 4"] | None = None,
) -> Float[Tensor, "*b K 4 4"]:
    """World motion of an object whose slip at the tool is measured: product of E_k S_k E_{k-1}^-1 over contacts.

    Of one that sticks to the tool while touched without slip: the paper's Delta T_r is the tool's motion in its own
    frame; the world motion of what sticks to it is `E' E^-1`. The approach does not move the object.

    Args:
        tool_pose: (*b, K, 4, 4), E_k, world_T_tool at each instant.
        in_contact: (*b, K), whether the tool touched; a step counts where both its ends do.
        slip: (*b, K, 4, 4), S_k, how the object moved against the tool since the instant before, in the tool's frame:
            `tool_T_object_k = S_k tool_T_object_(k-1)`; None for sticking contact. That at the first instant is not
            used, nor are those of steps without contact.

    Returns:
        from the first instant up to each.
    """
    identity = se3.identity(tool_pose.shape[:-3], dtype=tool_pose.dtype, device=tool_pose.device)
    motions = [identity]
    for k in range(1, tool_pose.shape[-3]):
        here = tool_pose[..., k, :, :] if slip is None else tool_pose[..., k, :, :] @ slip[..., k, :, :]
        step = here @ se3.inverse(tool_pose[..., k - 1, :, :])
        stuck = in_contact[..., k] & in_contact[..., k - 1]
        motions.append(torch.where(stuck[..., None, None], step, identity) @ motions[-1])
    return torch.stack(motions, -3)


def corrected_motion(
    motion: Float[Tensor, "*b K 4 4"],
    belief: PoseBelief,
    reading: Reading,
    discrepancy: Discrepancy,
    search: Search,
    descent: DescentSettings,
) -> Float[Tensor, "*b K 4 4"]:
    """World motion that best explains what was sensed, searched from another one (RUMI, Alg 5, corrected).

    As printed, Alg 5 applies one change of pose to all particles along each one's own axes; here the motion is
    one world motion M, and the representative particle i (least discrepancy) is moved to M W_i. The optimised
    correction is spread over the instants in proportion to the contact so far. Alg 5 starts from sticking contact.

    Args:
        motion: (*b, K, 4, 4), to start from, up to each instant.
        belief: before the action.
        reading: of the action.
        discrepancy: that the correction makes less.
        search: of poses.
        descent: method and iterations of the fit.
    """
    total = motion[..., -1, :, :]
    best = belief.discrepancy.argmin(-1)[..., None, None, None]
    poses = belief.world_T_object
    chosen = torch.gather(poses, -3, best.expand(*best.shape[:-3], 1, 4, 4))
    # what was sensed at each instant, brought to the end of the action by the motion still to come
    carried = attach(reading.observation, reading.instant, motion @ se3.inverse(total)[..., None, :, :])
    start = total[..., None, :, :] @ chosen
    found = descend(discrepancy, start, carried, search, descent)
    correction = found @ se3.inverse(start)
    touched = reading.in_contact.to(total.dtype).cumsum(-1)
    share = touched / touched[..., -1:].clamp_min(1.0)
    return se3.exp(share[..., None] * se3.log(correction)) @ motion


def object_motion(
    kind: Motion,
    belief: PoseBelief,
    reading: Reading,
    discrepancy: Discrepancy,
    search: Search,
    descent: DescentSettings,
    pushed: Predictor | None = None,
) -> Float[Tensor, "*b K 4 4"]:
    """Motion of the object up to each instant of a reading, by the chosen means; `pushed` is needed for its own."""
    if kind == "measured":
        if reading.object_motion is None:
            raise UsageError(
                "Expected every reading to have object_motion, since filter.motion is 'measured', got one without: "
                "report it, or choose a motion that needs none: 'corrected', 'pushed', 'estimated' or 'sticking'"
            )
        return reading.object_motion
    if kind == "sticking":
        return slip_motion(reading.tool_pose, reading.in_contact)
    if kind in ("pushed", "corrected"):
        if pushed is None:
            raise ValueError(f"Expected a push model for the motion {kind!r}, got None: give the filter one")
        motion = pushed(belief, reading)
        if kind == "pushed":
            return motion
        return corrected_motion(motion, belief, reading, discrepancy, search, descent)
    if kind == "estimated":
        motion = slip_motion(reading.tool_pose, reading.in_contact)
        return corrected_motion(motion, belief, reading, discrepancy, search, descent)
    raise ValueError(f"Expected motion to be one of {', '.join(MOTIONS)}, got {kind!r}")


@dataclass(frozen=True)
class PushedMotion:
    """Motion of the best-fitting particle under a push model, along the path that the tool reports.

    An action in which nothing was felt moved nothing, and is not predicted. Upright objects only.

    Attributes:
        predict: the push model's motion (`rumi.dynamics.base.PushModel.motion`).
    """

    predict: ObjectMotion

    @torch.no_grad()
    def __call__(self, belief: PoseBelief, reading: Reading) -> Float[Tensor, "*b K 4 4"]:
        """World motion up to each instant."""
        best = belief.discrepancy.argmin(-1)[..., None, None, None]
        poses, tool = belief.world_T_object, reading.tool_pose
        chosen = torch.gather(poses, -3, best.expand(*best.shape[:-3], 1, 4, 4))[..., 0, :, :]
        start, path = se3.to_planar(chosen).reshape(-1, 3), se3.to_planar(tool).reshape(-1, tool.shape[-3], 3)
        contact = reading.in_contact.any(-1).reshape(-1)
        motion = se3.identity((len(path), path.shape[1]), dtype=start.dtype, device=start.device).contiguous()
        motion[contact] = self.predict(start[contact], path[contact]).to(motion)
        return motion.reshape(tool.shape)
