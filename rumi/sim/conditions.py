"""Conditions of a simulated run: bundles of what sensors lack, and of how far the scene is off what is known of it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import radians
from typing import Any, Literal, TypeVar

from rumi.errors import UsageError
from rumi.sim.sensor_settings import SensorKind, SensorSettings
from rumi.sim.settings import SimSettings

Conditions = Literal["ideal", "lab", "harsh"]
_T = TypeVar("_T")


@dataclass(frozen=True)
class Member:
    """One number of the bundles.

    Attributes:
        name: of the setting below `simulator`, with dots.
        group: what it is put back to ideal with, to see what that costs.
        ideal, lab, harsh: its value.
    """

    name: str
    group: str
    ideal: float | bool | str
    lab: float | bool | str
    harsh: float | bool | str


MEMBERS = (
    Member("measures_motion", "motion", True, False, False),
    Member("sensors.motion_noise_m", "motion", 0.0, 0.0005, 0.001),
    Member("sensors.motion_noise_rad", "motion", 0.0, radians(0.5), radians(1.0)),
    Member("view.eye_m", "pixels", 0.0, 0.03, 0.05),
    Member("sensors.depth_noise_m", "pixels", 0.0, 0.002, 0.004),
    Member("view.holes", "pixels", 0.0, 0.05, 0.2),
    Member("view.mask_px", "pixels", 0, 1, 2),
    Member("free_margin_m", "pixels", 0.010, 0.010, 0.020),
    Member("sensors.calibration_m", "calibration", 0.0, 0.002, 0.004),
    Member("sensors.calibration_rad", "calibration", 0.0, radians(1.0), radians(2.0)),
    Member("pads.dead", "pads", 0.0, 0.05, 0.15),
    Member("pads.missed", "pads", 0.0, 0.02, 0.1),
    Member("pads.false", "pads", 0.0, 0.0002, 0.001),
    Member("tool_off_m", "tool pose", 0.0, 0.001, 0.002),
    Member("tool_off_rad", "tool pose", 0.0, radians(0.5), radians(1.0)),
    Member("cleared_by", "free space", "truth", "margin", "margin"),
    Member("stops_late_s", "late stop", 0.0, 0.02, 0.05),
    Member("build.mass", "build", 0.0, 0.2, 0.4),
    Member("build.friction", "build", 0.0, 0.2, 0.4),
    Member("build.com_m", "build", 0.0, 0.005, 0.01),
    Member("build.scale", "build", 0.0, 0.01, 0.02),
    Member("build.worn_m", "build", 0.0, 0.001, 0.0015),
    Member("sensors.bubble_noise_m", "bubbles", 0.0, 0.0005, 0.001),
    Member("sensors.lost", "images", 0.0, 0.1, 0.2),
    Member("sensors.late_s", "images", 0.0, 0.05, 0.1),
)
"""All of them; a setting that is none is the same in all conditions."""

GROUPS = tuple(dict.fromkeys(member.group for member in MEMBERS))


def bundle(conditions: str) -> dict[str, float | bool | str]:
    """The values of a condition by name.

    Raises:
        UsageError: there is no such condition.
    """
    if conditions not in ("ideal", "lab", "harsh"):
        raise UsageError(f"There are no conditions {conditions!r}; there are ideal, lab, harsh")
    return {member.name: getattr(member, conditions) for member in MEMBERS}


def under(settings: SimSettings, conditions: str) -> SimSettings:
    """Settings with the values of a condition in place of their own."""
    return _with(settings, bundle(conditions))


def image_errors(kind: SensorKind) -> SensorSettings:
    """Sensors of a kind with the errors that their images have under `lab`."""
    return under(SimSettings(sensors=SensorSettings(kind)), "lab").sensors


def put_back(settings: SimSettings, group: str) -> SimSettings:
    """Settings with one group of members as they are in ideal conditions."""
    return _with(settings, {member.name: member.ideal for member in MEMBERS if member.group == group})


def departures(settings: SimSettings, conditions: str) -> dict[str, Any]:
    """The members that have another value than in a condition, with that value."""
    found = {name: value_of(settings, name) for name in bundle(conditions)}
    return {name: value for name, value in found.items() if value != bundle(conditions)[name]}


def words(settings: SimSettings, conditions: str) -> str:
    """Name of a condition and what differs from it, for people."""
    other = ", ".join(f"{name} {value}" for name, value in departures(settings, conditions).items())
    return f"{conditions}, but {other}" if other else conditions


def value_of(settings: Any, name: str) -> Any:  # noqa: ANN401  (of any group, of the setting's type)
    """A setting by its name with dots."""
    for part in name.split("."):
        settings = getattr(settings, part)
    return settings


def _with(settings: _T, values: Mapping[str, Any]) -> _T:
    """A dataclass with other values, by names with dots."""
    own: dict[str, Any] = {}
    for name, value in values.items():
        first, _, rest = name.partition(".")
        own[first] = _with(own.get(first, getattr(settings, first)), {rest: value}) if rest else value
    return replace(settings, **own)  # type: ignore[type-var]
