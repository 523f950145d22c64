"""What a rummaging agent is made of, in a module of its own: what tells of an agent need not know how it acts."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from rumi.belief.initialise import InitialiseSettings
from rumi.belief.misfit import MisfitSettings
from rumi.belief.pose_filter import PoseFilter
from rumi.belief.reinitialise import ReinitialiseSettings
from rumi.dynamics.push_posterior import PushPosterior
from rumi.fields.workspace import Workspace
from rumi.information.stopping import StopSettings
from rumi.planning.policy import Policy
from rumi.robot.tool import Tool
from sdf.object_model import ObjectModel


@dataclass(frozen=True)
class RummagerParts:
    """Parts and settings of a `Rummager`.

    Attributes:
        model: the object's shape.
        filter: follows the readings.
        policy: chooses the actions.
        workspace: the lattice of the fields.
        tool: the robot's body and free-space motion.
        initialise: how the first belief is found.
        renewal: when and how particles are drawn anew; only where the filter has a prior.
        stop_rule: when the belief is sure.
        misfit: when a reading fits no pose that is believed.
        height_m: z of the origin of an upright object.
        replan_every: actions carried out of one plan; a contact always asks for a new one.
        budget_s: seconds that one plan may take, or None.
        nll_threshold, position_tolerance_m, rotation_tolerance_rad: what counts as right (metrics only).
        agreement_points: sample of the surface that the belief compares itself on.
        steps: actions at most; None for as many as the loop allows.
        upright: whether the object is expected to stand as it did at first.
        looks_again: whether a camera sees the object after every action too.
        senses_motion: whether something senses how the object moves.
        sensors: what the robot senses by, for people.
        conditions: what a simulated robot lacks, for people; empty for another.
        approach_m: length of an action that may touch the object; 0 for as long as planned.
        retreats: whether the tool goes back from an object that leans on it, and lets go of one before it is sure.
        remarks: whether steps are remarked on.
        pushes: prior over push parameters, which plans draw and measured motions teach; None where they are fixed.
        about: what a run's folder tells of the settings.
    """

    model: ObjectModel
    filter: PoseFilter
    policy: Policy
    workspace: Workspace
    tool: Tool
    initialise: InitialiseSettings = field(default_factory=InitialiseSettings)
    renewal: ReinitialiseSettings = field(default_factory=ReinitialiseSettings)
    stop_rule: StopSettings = field(default_factory=StopSettings)
    misfit: MisfitSettings = field(default_factory=MisfitSettings)
    height_m: float = 0.0
    replan_every: int = 1
    budget_s: float | None = None
    nll_threshold: float = 20.0
    position_tolerance_m: float = 0.005
    rotation_tolerance_rad: float = 0.17453
    agreement_points: int = 200
    steps: int | None = None
    upright: bool = True
    looks_again: bool = False
    senses_motion: bool = False
    sensors: str = "a first view, felt points"
    conditions: str = ""
    approach_m: float = 0.0
    retreats: bool = False
    remarks: bool = True
    pushes: PushPosterior | None = None
    about: Mapping[str, Any] = field(default_factory=dict, compare=False)
