"""Settings of the simulator: time steps, sensors and physics."""

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro

from rumi.errors import UsageError
from rumi.sim.error_settings import BuildSpread, PadErrors, ViewErrors
from rumi.sim.sensor_settings import SensorSettings
from sdf.bounds import Checked, Count, Finite, NotNegative, Positive

_GUARD_M, _GUARD_SEEN_M, _GUARD_IN_SPACE_M = 0.015, 0.03, 0.008


@dataclass(frozen=True)
class SimSettings(Checked, refusal=UsageError):
    """Settings of the simulator; the defaults are quick.

    Attributes:
        time_step_s: of the physics.
        mini_steps: equal parts of an action; the sensors report at the end of each.
        action_s: duration of the commanded motion; slow enough that the outcome hardly depends on it.
        hold_s: standing still at the end of an action, part of the last mini step.
        action_scale_m: metres that a control of 1 asks for.
        action_scale_rad: radians that a control of 1 asks for.
        contact_m: a pad point this close to the object's surface is felt (RUMI, V.A).
        pad_spacing_m: spacing of the points on the pads.
        body_spacing_m: spacing of the points in the gripper's volume, which is known to be free.
        free_spacing_m: lattice on which free points are reported.
        free_margin_m: the camera reports free space up to this before what it sees.
        free_fraction: part of the seen depth up to which it reports free space, in place of the margin (the
            paper: 0.95); None for the margin.
        free_region_m: free points are reported in the box about the first view's surface points grown by this
            much, which rides with the object as its motion is measured; farther points refute no pose that the
            view leaves open.
        measures_motion: whether a slip sensor reports the object's motion.
        robot: what moves the gripper: nothing ("gripper", which flies), or the "arm" that its reach is of, by inverse
            kinematics and computed torque, whose links touch too.
        cleared_by: what swept points are reported free: by the "truth" those of the whole gripper that lie farther
            than `contact_m` outside of the true surface; by a "margin" those that lie deeper than that in the gripper.
        guarded: whether actions are guarded moves, which end once pads have felt something for `guard_m` of the way;
            "auto": where nothing measures how a push moves the object, and each particle goes its own way. Else they
            are carried out whole, whatever is felt.
        guard_m: how far a guarded move goes on while its pads feel something; None for 8 mm of a tool that moves in
            space, where what is pushed tips and slips, 30 where a camera sees what a push did, else 15.
        stops_late_s: how much longer than `action_s` an action goes on at its speed, or than `guard_m` lets it.
        tool_off_m: error of where the tool is taken to be, in a random direction, constant for a run.
        tool_off_rad: error of its yaw.
        view: what is wrong with the camera's views.
        pads: what is wrong with pads that feel points.
        build: how the object differs from what is known of it.
        sensors: through which the task reports; those of kind "points" know where the pads are near the true surface.
    """

    time_step_s: Positive = 0.004
    mini_steps: Count = 20
    action_s: Positive = 1.0
    hold_s: float = 0.1
    action_scale_m: float = 0.08
    action_scale_rad: float = 0.5
    contact_m: Positive = 0.003
    pad_spacing_m: Positive = 0.0025
    body_spacing_m: Positive = 0.005
    free_spacing_m: Positive = 0.005
    free_margin_m: float = 0.010
    free_fraction: float | None = None
    free_region_m: float = 0.10
    measures_motion: bool = True
    robot: Annotated[Literal["gripper", "arm"], tyro.conf.arg(name="robot", prefix_name=False)] = "gripper"
    cleared_by: Literal["truth", "margin"] = "truth"
    guarded: Literal["auto", "always", "never"] = "auto"
    guard_m: NotNegative | None = None
    stops_late_s: NotNegative = 0.0
    tool_off_m: NotNegative = 0.0
    tool_off_rad: NotNegative = 0.0
    view: ViewErrors = field(default_factory=ViewErrors)
    pads: PadErrors = field(default_factory=PadErrors)
    build: BuildSpread = field(default_factory=BuildSpread)
    sensors: SensorSettings = field(default_factory=SensorSettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.action_s / self.mini_steps < self.time_step_s:
            raise UsageError(
                f"Expected each of mini_steps ({self.mini_steps}) to last at least one time_step_s "
                f"({self.time_step_s} s) of action_s ({self.action_s} s): use fewer mini steps or a smaller time step"
            )

    def guard_of(self, *, spatial: bool, looks_again: bool = False) -> float:
        """How far a guarded move of a tool goes on, metres.

        Args:
            spatial: whether the tool moves in space; else it is level.
            looks_again: whether a camera sees what a push did, and what it turned into view.
        """
        if self.guard_m is not None:
            return self.guard_m
        if spatial:
            return _GUARD_IN_SPACE_M
        return _GUARD_SEEN_M if looks_again else _GUARD_M


@dataclass(frozen=True)
class PhysicsSettings(Checked, refusal=UsageError):
    """Masses, friction and the gripper's drive.

    Attributes:
        mass_kg: of the object.
        friction: sliding friction of everything.
        com_m: by which the object's centre of mass is off that of its even material, its own frame.
        gripper_mass_kg: inertia of the drive along x and y.
        gripper_inertia: inertia of the drive about z, kg m^2.
        bandwidth_hz: of the critically damped position servos.
        max_force_n: of the drive along x and y.
        max_lift_n: of the drive along z, for a gripper that moves in space.
        max_torque_nm: of the drive about z.
        lead_m: by how much a command may be ahead of the measured position along an axis; infinite for any.
        wall_boxes: boxes that make up the wall of a cup.
        handle_capsules: capsules that make up its handle.
        collision: how a mesh collides, by its convex "pieces", its "hull", or "auto": pieces where the library for
            that is installed.
        concavity: how far a piece may be from convex, relative to half of the mesh's longest side.
    """

    mass_kg: Positive = 0.35
    friction: Positive = 0.5
    com_m: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    gripper_mass_kg: float = 10.0
    gripper_inertia: float = 0.1
    bandwidth_hz: float = 20.0
    max_force_n: float = 200.0
    max_lift_n: float = 200.0
    max_torque_nm: float = 20.0
    lead_m: float = math.inf
    wall_boxes: int = 24
    handle_capsules: int = 12
    collision: Literal["auto", "pieces", "hull"] = "auto"
    concavity: float = 0.05
