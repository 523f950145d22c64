"""Everything that a run needs beside the task, in one value."""

from dataclasses import dataclass, field

from rumi.belief.initialise import InitialiseSettings
from rumi.belief.pose_filter import PoseFilter
from rumi.belief.reinitialise import RenewalSettings
from rumi.fields.workspace import Workspace
from rumi.information.stopping import StopSettings
from rumi.planning.policy import Policy
from rumi.robot.tool import Tool
from sdf.object_model import ObjectModel


@dataclass(frozen=True)
class Rummager:
    """Everything that a run needs beside the task; settings only, no state.

    Attributes:
        model: the object's shape.
        filter: follows the readings.
        policy: chooses the actions.
        workspace: the lattice of the fields.
        tool: the robot's body and free-space motion.
        initialise: how the first belief is found.
        renewal: when and how particles are drawn anew; only where the filter has a prior.
        stop: when to stop.
        height_m: z of the origin of an upright object.
        replan_every: actions carried out of one plan; a contact always asks for a new one.
        budget_s: seconds that one plan may take, or None.
        nll_threshold, position_tolerance_m, rotation_tolerance_rad: what counts as right (metrics only).
        agreement_points: sample of the surface that the belief compares itself on.
    """

    model: ObjectModel
    filter: PoseFilter
    policy: Policy
    workspace: Workspace
    tool: Tool
    initialise: InitialiseSettings = field(default_factory=InitialiseSettings)
    renewal: RenewalSettings = field(default_factory=RenewalSettings)
    stop: StopSettings = field(default_factory=StopSettings)
    height_m: float = 0.0
    replan_every: int = 1
    budget_s: float | None = None
    nll_threshold: float = 20.0
    position_tolerance_m: float = 0.005
    rotation_tolerance_rad: float = 0.17453
    agreement_points: int = 200
