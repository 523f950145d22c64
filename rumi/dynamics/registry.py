"""Registry of push models: members by name, their settings, and the one that a run uses."""

from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.base import PushModel, RolloutModel, Use
from rumi.dynamics.displacement import DisplacementPush
from rumi.dynamics.displacement_rollouts import DisplacementSettings
from rumi.dynamics.push_posterior import FIXED, PushPosterior
from rumi.dynamics.quasi_static import QuasiStaticSettings
from rumi.dynamics.quasi_static_push import QuasiStaticPush
from rumi.dynamics.scene_rollouts import SceneRollouts
from rumi.errors import UsageError
from rumi.fields.information import WorkspaceFields
from rumi.fields.workspace import Workspace
from rumi.registry import Table
from rumi.robot.tool import Tool
from sdf.bounds import Checked, CountOr0, NotNegative, Positive
from sdf.check import check_shape
from sdf.containers import index
from sdf.object_model import ObjectModel

PUSH_MODELS: Table[type[PushModel]] = Table("push model", "rumi.push_models")
"""Push models by name; a package from outside adds one by an entry point of the group "rumi.push_models"."""

AUTO = "auto"
"""The quasi-static model for upright particles and a level tool, else the displacement model."""


@dataclass(frozen=True)
class EngineSettings(Checked):
    """Settings of the push model that is a physics engine.

    Attributes:
        time_step_s: of the physics.
        action_s: duration of an action.
        hold_s: standing still after it.
        friction: of everything.
        mass_kg: of the object.
        threads: that step at once; 0 for as many as torch has. The rollouts are the same to the bit.
    """

    time_step_s: Positive = 0.005
    action_s: Positive = 1.0
    hold_s: NotNegative = 0.1
    friction: Positive = 0.5
    mass_kg: Positive = 0.35
    threads: CountOr0 = 0


@dataclass(frozen=True)
class PushSettings(Checked):
    """Choice of a push model, and the settings of each.

    Attributes:
        push_model: how the object is expected to move: "displacement" carries it with the point that touches it, as
            in the paper; "quasi-static" pushes single poses of the belief, which slide and turn; "mujoco" does so with
            the simulator's physics (slow: ask for few samples); or a name that an installed package adds. "auto" is
            the quasi-static model where it can be, with upright particles and a level tool, and the displacement model
            elsewhere.
        push_parameters: how the object slides, for the quasi-static model: "fixed", as its settings say; "prior", where
            each rollout has its own draw of how real objects slide, with a tool of about the settings' friction, and
            motions that are measured teach it; or a file of what was learnt of the object, as
            `rumi pushes --out` writes.
        push: settings of the displacement model.
        quasi_static: settings of the quasi-static model.
        engine: settings of the physics.
    """

    push_model: str = AUTO
    push_parameters: str = FIXED
    push: DisplacementSettings = field(default_factory=DisplacementSettings)
    quasi_static: QuasiStaticSettings = field(default_factory=QuasiStaticSettings)
    engine: EngineSettings = field(default_factory=EngineSettings)

    def __post_init__(self) -> None:
        """Refuse a model that there is not."""
        super().__post_init__()
        if self.push_model != AUTO and self.push_model not in PUSH_MODELS:
            names = ", ".join((AUTO, *PUSH_MODELS))
            raise UsageError(f"Expected push_model to be one of {names}, got {self.push_model!r}")


PUSH_MODELS.add("displacement", DisplacementPush)
PUSH_MODELS.add("quasi-static", QuasiStaticPush)
PUSH_MODELS.add("mujoco", "rumi.sim.push_model:MujocoPush")  # by address: only where it is chosen is MuJoCo loaded


def push_model(name: str, use: Use, settings: PushSettings | None = None) -> PushModel:
    """The push model of a name.

    Args:
        name: of `PUSH_MODELS`.
        use: that it is to have.
        settings: of the models; by default their defaults.

    Raises:
        UsageError: there is no such model, or it lacks the use; the message lists the names.
    """
    member = PUSH_MODELS[name]
    if not member.has(use):
        names = ", ".join(PUSH_MODELS)
        raise UsageError(f"Expected a push model with the use {use!r}, got {name!r}, which lacks it: choose of {names}")
    return member.make(settings or PushSettings())


class PushModels:
    """The push models of a run, each made once.

    Args:
        settings: the choice and all members' settings.

    Raises:
        UsageError: the chosen model has no rollouts.
    """

    def __init__(self, settings: PushSettings | None = None) -> None:
        self.settings = settings or PushSettings()
        self._made: dict[str, PushModel] = {}
        if self.settings.push_model != AUTO:
            self._member(self.settings.push_model)

    def chosen(self, world_T_object: Float[Tensor, "N 4 4"], tool: Tool) -> str:
        """Name of the member that pushes these particles with this tool.

        That is the displacement model where "auto" has no other, and for what a tool in space has toppled.

        Raises:
            ValueError: the particles are of several scenes, each of which has a member of its own.
        """
        check_shape("world_T_object", world_T_object, "(N, 4, 4)", last=(4, 4))
        name = self.settings.push_model
        if name == AUTO:
            return "quasi-static" if self._member("quasi-static").fits(world_T_object, tool) else "displacement"
        if tool.spatial and not self._member(name).fits(world_T_object, tool):
            return "displacement"
        return name

    def rollouts(
        self,
        model: ObjectModel,
        world_T_object: Float[Tensor, "*b N 4 4"],
        log_weights: Float[Tensor, "*b N"],
        tool: Tool,
        workspace: Workspace,
        fields: WorkspaceFields,
        *,
        pushes: PushPosterior | None = None,
    ) -> RolloutModel:
        """Rollouts under one belief, by the member that suits it; see `PushModel.rollouts`.

        What was learnt of how the object slides, `pushes`, takes the place of what a member was made with. Of a batch
        of scenes, (B, N, 4, 4), each has the member that suits it by itself; those of one member that can be taken
        together are.
        """
        several = world_T_object.ndim > 3
        names = {self.chosen(poses, tool) for poses in (world_T_object if several else (world_T_object,))}
        member = self._member(names.pop())
        if several and (names or not member.takes_scenes(world_T_object)):
            rows = enumerate(zip(world_T_object, log_weights, strict=True))
            each = ((*row, tool, workspace, index(fields, scene)) for scene, row in rows)
            return SceneRollouts([self.rollouts(model, *own, pushes=pushes) for own in each])
        member = member if pushes is None else member.knowing(pushes)
        return member.rollouts(model, world_T_object, log_weights, tool, workspace, fields)

    def _member(self, name: str) -> PushModel:
        if name not in self._made:
            self._made[name] = push_model(name, "rollouts", self.settings)
        return self._made[name]
