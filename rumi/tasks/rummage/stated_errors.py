"""What a belief takes robot, camera and object to be off by: as widths of its sensors, or as errors of a whole run."""

import math
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.errors import UsageError
from rumi.sim.sensor_settings import SensorSettings
from rumi.sim.settings import SimSettings
from rumi.tasks.rummage.scene_spec import CameraSpec

_FROM_TARGET_M = 0.17  # of the point that a camera is calibrated by: how far the object may stand off it
_NEARER = 0.9  # of a depth's noise: matched to the nearest surface, seen points draw a thin wall so far to the camera
# noise of the motion where shape, balance or hand are not as known, fitted under `lab`: times that of exact ones, and
# the length that each instant of a push counts as beside its step
_WIDER, _LEAST_M = 1.5, 0.0015
_FIRST = 1000  # particles of a first touch


def as_accurate(own: PoseTrajectorySettings, simulator: SimSettings) -> PoseTrajectorySettings:
    """The widths of sensors and heights with what they are stated to be off by: calibration, tool pose, wear, size.

    Each is drawn once a run: in a random direction, of which one axis counts, or evenly up to a depth, about the model.
    """
    worn, size = simulator.build.worn_m / math.sqrt(3.0), simulator.build.scale / math.sqrt(3.0)
    camera = simulator.sensors.calibration_m / math.sqrt(3.0)
    own = own.wider(math.hypot(camera, worn), math.hypot(simulator.tool_off_m / math.sqrt(2.0), worn))
    return _as_sensed(replace(own, height_off=own.height_off or (worn, size)), simulator)


def _as_sensed(own: PoseTrajectorySettings, simulator: SimSettings) -> PoseTrajectorySettings:
    """The widths of a sensed motion, and of what is seen, with what their sensors are stated to err by.

    Where nobody knows the camera's place the nearer side of a wall hides the noise of its depth.
    """
    stated = simulator.sensors
    return replace(
        own,
        seen_sd_m=math.hypot(own.seen_sd_m, 0.0 if own.eye_m is None else stated.depth_noise_m),
        moved_m=math.hypot(own.moved_m, stated.motion_noise_m),
        moved_rad=math.hypot(own.moved_rad, stated.motion_noise_rad),
    )


def as_inexact(
    own: PoseTrajectorySettings, simulator: SimSettings, bounds: Float[Tensor, "2 3"], camera: CameraSpec | None = None
) -> PoseTrajectorySettings:
    """The systematic errors of a run, and pads, motion and physics as uncertain, as they are stated to be.

    Calibration and tool pose are off in a random direction, of which one axis counts; wear is even up to a depth; size,
    friction and centre of mass are even about the model's. What hangs on a worn part goes in with it, as a mug's handle
    does with its wall: that is no depth, but about as if the object were smaller.

    Args:
        own: of the belief.
        simulator: what is stated.
        bounds: of the object, of which the lesser width turns a depth of wear into a share of its size.
        camera: whose calibration is off, if there is one.
    """
    build, sensors, pads = simulator.build, simulator.sensors, simulator.pads
    width_m = float((bounds[1] - bounds[0])[:2].min())
    known = not any((build.com_m, build.scale, build.worn_m, simulator.tool_off_m))
    wider, least_m = (1.0, 0.0) if known else (_WIDER, _LEAST_M)
    drawn_near = 0.0 if own.eye_m is not None else _NEARER * sensors.depth_noise_m / math.sqrt(2.0)
    if camera is not None:
        own = replace(own, view_off_m=math.hypot(own.view_off_m, drawn_near))
        own = _as_calibrated(own, sensors, camera, 0.5 * float(bounds[1, 2] - bounds[0, 2]))
    return replace(
        _as_sensed(own.freer(wider), simulator),
        tool_off_m=math.hypot(own.tool_off_m, simulator.tool_off_m / math.sqrt(2.0)),
        tool_off_rad=math.hypot(own.tool_off_rad, simulator.tool_off_rad),
        worn=(own.worn[0] + 0.5 * build.worn_m, math.hypot(own.worn[1], build.worn_m / math.sqrt(12.0))),
        size_off=math.hypot(own.size_off, build.scale / math.sqrt(3.0), build.worn_m / (width_m * math.sqrt(3.0))),
        first_particles=own.first_particles if known else max(own.first_particles, _FIRST),
        missed=max(own.missed, pads.missed),
        dead=max(own.dead, pads.dead),
        false=max(own.false, pads.false),
        friction=(own.friction[0], math.hypot(own.friction[1], build.friction / math.sqrt(3.0))),
        centre_m=math.hypot(own.centre_m, build.com_m / math.sqrt(5.0)),
        least_m=max(own.least_m, least_m),
    )


def _as_calibrated(
    own: PoseTrajectorySettings, sensors: SensorSettings, camera: CameraSpec, middle_m: float
) -> PoseTrajectorySettings:
    """Views as far off as a camera's calibration is stated to be, in the plane at which the object's middle is.

    A camera is turned about the point that it was calibrated by, or about itself: about a vertical axis, which shifts
    what stands off it to one side, and about level ones, which shift what is higher or lower. Seen points that a level
    axis lifts or lowers are left as they are. A task knows its camera; where nobody knows that point the object is
    taken to stand some way off it in any direction.
    """
    if own.view_off_rad > 0 and own.view_about_m is None:
        raise UsageError("Expected --filter.trajectories.view-about-m with view-off-rad, got none: about which point?")
    shift, turn = sensors.calibration_m / math.sqrt(3.0), sensors.calibration_rad / math.sqrt(3.0)
    if own.view_about_m is None and own.eye_m != camera.position:
        return replace(own, view_off_m=math.hypot(own.view_off_m, shift, _FROM_TARGET_M * turn))
    point = camera.position if sensors.turned_about == "sensor" else camera.target
    apart_m = middle_m - point[2] if own.view_about_m is None else 0.0
    return replace(
        own,
        view_off_m=math.hypot(own.view_off_m, shift, apart_m * turn),
        view_off_rad=math.hypot(own.view_off_rad, turn),
        view_about_m=own.view_about_m or point[:2],
    )
