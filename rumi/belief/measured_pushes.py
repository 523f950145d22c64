"""Pushes of a run whose outcome was measured, or seen again, to learn push parameters from."""

from collections.abc import Sequence

from rumi.belief.particles import PoseBelief
from rumi.dynamics.along_path import unwrapped
from rumi.dynamics.pushed_body import ObservedPush
from sdf import se3
from sensors.reading import Reading


def measured_pushes(steps: Sequence[tuple[PoseBelief, Reading]]) -> list[ObservedPush]:
    """Every action of a run that touched the object, with its poses as the run's last belief has them.

    The likeliest pose at the end, carried back by the motions that the filter took in, is where the object was before
    each action: errors of the first beliefs are no errors of the push model.

    Args:
        steps: belief and reading of each step, the first view first; upright objects and a level tool.
    """
    last = steps[-1][0]
    attached_T_object = se3.compose(se3.inverse(last.world_T_attached), last.mode())
    poses = [se3.to_planar(se3.compose(belief.world_T_attached, attached_T_object)).double() for belief, _ in steps]
    found = []
    for before, after, (_, reading) in zip(poses, poses[1:], steps[1:], strict=False):
        if bool(reading.in_contact.any()):
            path = unwrapped(se3.to_planar(reading.tool_pose).double())
            found.append(ObservedPush(before, path, after))
    return found
