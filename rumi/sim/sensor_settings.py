"""Settings of the simulated sensors: which there are, and their errors."""

from dataclasses import dataclass
from typing import Literal

from rumi.errors import UsageError
from sdf.bounds import Checked, NotNegative, Positive, ShareBelow1

SensorKind = Literal["points", "camera", "bubbles", "both"]


@dataclass(frozen=True)
class SensorSettings(Checked, refusal=UsageError):
    """Sensors of a task; what they report goes through the same converters as a real robot's.

    Attributes:
        kind: "points" reports surface points within the simulator's `contact_m` of the pads; "camera" looks after every
            action, and nothing is felt; "bubbles" feels by a membrane over each pad, after one first look; or "both".
        depth_noise_m: standard deviation of each pixel of the camera's depth.
        bubble_noise_m: the same for the cameras in the bubbles.
        motion_noise_m: standard deviation of the slip sensor's error along x and y, for an action that moved the
            object, beside the task's own.
        motion_noise_rad: the same for yaw.
        lost: part of the images that never arrive.
        late_s: by which images of the bubbles are later than the pose of the tool that they are taken to belong to.
        calibration_m: error of where each camera is taken to be, in a random direction.
        calibration_rad: error of how it is taken to be turned, about a random axis.
        turned_about: point that the camera's wrong turn leaves in place: the "workspace", where a calibration looks at
            its target, or the "sensor" itself. Bubbles turn about their own camera.
        membrane_m: of the bubbles' membrane above the pads.
        frame_rate_hz: of the camera, for 0.4 s after an action.
        further: names of sensors beside those (`rumi.sim.sensors.SIMULATED_SENSORS`), which count by evidence of their
            own (`filter.evidence`).
        wrist_force: whether a force sensor at the wrist reports the tool's mean force in each mini step.
        wrist_noise_n: standard deviation of each of its numbers.
    """

    kind: SensorKind = "points"
    depth_noise_m: float = 0.0
    bubble_noise_m: float = 0.0
    motion_noise_m: float = 0.0
    motion_noise_rad: float = 0.0
    lost: ShareBelow1 = 0.0
    late_s: float = 0.0
    calibration_m: float = 0.0
    calibration_rad: float = 0.0
    turned_about: Literal["workspace", "sensor"] = "workspace"
    membrane_m: Positive = 0.008
    frame_rate_hz: Positive = 15.0
    further: tuple[str, ...] = ()
    wrist_force: bool = False
    wrist_noise_n: NotNegative = 0.2

    @property
    def looks(self) -> bool:
        """Whether the camera looks after every action."""
        return self.kind in ("camera", "both")

    @property
    def feels(self) -> bool:
        """Whether there are bubbles."""
        return self.kind in ("bubbles", "both")
