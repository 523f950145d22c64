"""Errors of sensors that a task does not have: settings of them that are refused."""

from rumi.errors import UsageError
from rumi.sim.conditions import bundle, value_of
from rumi.sim.settings import SimSettings
from rumi.tasks.rummage.scene_spec import TaskSpec
from rumi.tasks.rummage.settings import Settings

_OF_IMAGES = ("bubble_noise_m", "lost", "late_s", "membrane_m", "frame_rate_hz")
_OF_CAMERA = ("depth_noise_m", "calibration_m", "calibration_rad", "turned_about")


def check_errors(spec: TaskSpec, settings: Settings) -> None:
    """Refuse errors of what a run does not sense by; those that its conditions have, and no one asked for, are idle.

    Raises:
        UsageError: which setting, and what it would need.
    """
    own, usual, bundled = settings.simulator, SimSettings(), bundle(settings.conditions)
    for name, needs in _idle(spec, own).items():
        value = value_of(own, name)
        if value not in (value_of(usual, name), bundled.get(name)):
            flag = f"--simulator.{name.replace('_', '-')}"
            raise UsageError(f"Expected {needs} with {flag} {value}: {spec.name} has nothing that it is an error of")


def _idle(spec: TaskSpec, own: SimSettings) -> dict[str, str]:
    """Settings that do nothing, and what they would need."""
    kind = own.sensors.kind
    found: dict[str, str] = {}
    if kind == "points":
        needs = "--simulator.sensors.kind camera, bubbles or both"
        found |= {f"sensors.{name}": needs for name in _OF_IMAGES}
    else:
        names = ("pads.dead", "pads.patch_m", "pads.missed", "pads.false", "view.mask_px", "cleared_by")
        found |= dict.fromkeys(names, "--simulator.sensors.kind points")
    if spec.camera is None:
        needs = "a task with a camera"
        found |= {f"sensors.{name}": needs for name in _OF_CAMERA}
        found |= {f"view.{name}": needs for name in ("eye_m", "holes", "mask_px")}
    if not (own.measures_motion and spec.measures_motion):
        needs = "--simulator.measures-motion and a task that has a slip sensor"
        found |= {f"sensors.{name}": needs for name in ("motion_noise_m", "motion_noise_rad")}
    return found
