"""Settings of the handle task: which sensors, their noise, how far belief and thinking go."""

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal, get_args

import tyro

from rumi.belief.contact_evidence import SignalSettings
from rumi.errors import UsageError
from rumi.sim.joint_torques import JointSettings
from rumi.tasks.rummage.scene_spec import PriorSpec, TaskSpec
from rumi.tasks.rummage.scenes import large_handled_mug
from sdf.bounds import Checked, Count, NotNegative, Positive

SensorName = Literal["camera", "bubbles", "wrench", "torques"]
SENSORS: tuple[SensorName, ...] = get_args(SensorName)
"""The sensors by name; `all` of them is what the run is about."""


def sensors_of(text: str) -> tuple[SensorName, ...]:
    """The sensors that a text names, in their own order: all, or some with commas between.

    Raises:
        UsageError: there is no such sensor.
    """
    named = SENSORS if text == "all" else tuple(text.split(","))
    for name in named:
        if name not in SENSORS:
            raise UsageError(f"There is no sensor {name!r}; there are all, {', '.join(SENSORS)}")
    return tuple(name for name in SENSORS if name in named)


_AS_WORDS = tyro.constructors.PrimitiveConstructorSpec(
    nargs=1,
    metavar="all|NAME,NAME",
    instance_from_str=lambda words: sensors_of(words[0]),
    is_instance=lambda value: isinstance(value, tuple),
    str_from_instance=lambda value: ["all" if value == SENSORS else ",".join(value)],
)


@dataclass(frozen=True)
class WristSettings:
    """The force-torque sensor between wrist and gripper, of which the mean over a mini step is one reading.

    Attributes:
        force_n: standard deviation of a reading's forces.
        moment_nm: of its moments.
        behind_m: of the tool frame, where the sensor's origin is.
        least_force_n: a force below it is none.
        friction: bound on the coefficient between gripper and object.
        most: touches that count of an action: those of the strongest force in as many parts of it. Others are of the
            same place.
        point_m: standard deviation of what else moves a touched point: two touches that look like one, the measured
            motion since, the shape.
        normal_rad: the same of its normal.
        outlier: share of touches that tell nothing.
    """

    force_n: float = 0.05
    moment_nm: float = 0.001
    behind_m: float = 0.13
    least_force_n: float = 1.0
    friction: float = 0.6
    most: int = 3
    point_m: float = 0.003
    normal_rad: float = 0.3
    outlier: float = 0.1


@dataclass(frozen=True)
class HandleSettings(Checked, refusal=UsageError):
    """Settings of `rumi run handle`.

    Attributes:
        sensors: whose evidence the belief takes in: all, or some of camera, bubbles, wrench and torques, with commas
            between.
        run_budget_s: of time, on a clock that runs while the robot thinks, moves and grasps.
        thinking_s: that a plan and a belief's update are taken to last on that clock; None for what they last here,
            and the planner then makes do with what is left.
        preset: of planner and belief.
        renewals: actions with contact, from the first on, after which poses drawn anew are put beside the belief's;
            where no point of the surface was ever seen or felt, all of them.
        fit_a_contact: discrepancy by which the best pose may fit worse for each action that touched (`StopSettings`).
        contacts: actions that must have touched before the belief counts as sure.
        steps: actions over which nll is summed up; a belief that stopped keeps its last.
        wrist: the force-torque sensor.
        signals: what contact signals count for.
        joints: torque sensors and observer.
        free_region_m: free points are kept in the box about what the camera saw, grown by this much.
        spread_m: standard deviation of where the mug stands, along x and along y; also what the robot knows.
        handle_rad: its handle points away from the camera, to within this.
        noise_free: sensors without noise, loss, delay or wrong calibration, of which the belief still expects the usual
            errors: what the noise costs.
    """

    sensors: Annotated[tuple[SensorName, ...], _AS_WORDS] = SENSORS
    run_budget_s: Annotated[Positive, tyro.conf.arg(metavar="SECONDS")] = 60.0
    thinking_s: NotNegative | None = 1.0
    preset: Annotated[str, tyro.conf.Suppress] = "fast"
    renewals: int = 3
    fit_a_contact: float = 3.0
    contacts: int = 2
    steps: Count = 20
    wrist: WristSettings = field(default_factory=WristSettings)
    signals: SignalSettings = field(default_factory=SignalSettings)
    joints: JointSettings = field(default_factory=JointSettings)
    free_region_m: float = 0.05
    spread_m: Positive = 0.03
    handle_rad: float = math.radians(20.0)
    noise_free: bool = False

    def __post_init__(self) -> None:
        """Refuse a hand without sensors."""
        super().__post_init__()
        if not self.sensors:
            raise UsageError(f"Expected one or more sensors of {', '.join(SENSORS)}, got none")


def task_of(settings: HandleSettings) -> TaskSpec:
    """The scene: a mug before the arm, its handle hidden from the camera."""
    mean = (0.50, 0.0)
    return TaskSpec(
        "fused",
        "a mug seen once, then felt by bubbles, a wrench and joint torques, on one belief, and lifted by its handle",
        large_handled_mug,
        (*mean, 0.0),
        prior=PriorSpec(mean, settings.spread_m),
        tool_start=(0.32, 0.0, 0.0),
        steps=settings.steps,
    )
