"""Likelihood of a sensed motion along a pushed object's trajectory: a slip sensor or a tracker tells how it went.

A sensor of motion is evidence, with noise, as any other is: it tells a particle from another by how each went from one
segment's beginning to its end, and is no command by which all of them move. The reading is the motion in the world.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rumi.belief.trajectory_settings import PoseTrajectorySettings
from sdf import se3
from sensors.reading import Reading

USUAL_NATS = -2.0
"""Log-likelihood of a segment's sensed motion where it is what the particle's was, about."""

_FREEDOM, _NUMBERS = 4.0, 3.0  # degrees of freedom of Student's t, and numbers that a motion tells of a pushed object


def motion_of(reading: Reading, instants: Int[Tensor, "k"]) -> Float[Tensor, "4 4"] | None:
    """Motion in the world over some instants of an action that follow each other; None where none was sensed."""
    sensed = reading.object_motion
    if sensed is None:
        return None
    begin = int(instants[0])
    end = sensed[int(instants[-1])].double()
    return end if begin == 0 else end @ se3.inverse(sensed[begin - 1].double())


def way_sensed(reading: Reading, world_T_object: Float[Tensor, "n 4 4"]) -> float:
    """How far an object at the middle one of some poses went in an action, metres; 0 where no motion was sensed."""
    motion = motion_of(reading, torch.arange(len(reading.tool_pose)))
    return 0.0 if motion is None else float(se3.distance(motion @ world_T_object, world_T_object)[0].median())


def log_likelihood_of_motions(
    world_T_object: Float[Tensor, "N S1 4 4"],
    motion: Float[Tensor, "S 4 4"],
    power: Float[Tensor, "S"],
    own: PoseTrajectorySettings,
) -> Float[Tensor, "N S"]:
    """Log-likelihood of each segment's sensed motion, up to a constant: Student's t of how far off place and turn are.

    Its tails fall off slowly, so that a sensor that errs now and then rules nothing out, and never end, so that of
    particles that are all far off the nearer ones are likelier still.

    Args:
        world_T_object: poses before the first segment and after each.
        motion: that was sensed, of the world.
        power: to which that is raised; 0 where none was sensed.
        own: of `moved_m` and `moved_rad`.
    """
    metres, radians = se3.distance(motion @ world_T_object[:, :-1], world_T_object[:, 1:])
    off = (metres / own.moved_m).square() + (radians / own.moved_rad).square()
    return -0.5 * (_FREEDOM + _NUMBERS) * power * (off / _FREEDOM).log1p()
