"""The family of push models by name, each made for one belief."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.base import PushModel
from rumi.dynamics.contact import ContactField
from rumi.dynamics.displacement import DisplacementModel, DisplacementSettings
from rumi.dynamics.outline import GridOutline, Support, support_of
from rumi.dynamics.quasi_static import QuasiStaticModel, QuasiStaticSettings
from rumi.fields.information import WorkspaceFields
from rumi.fields.workspace import Workspace
from rumi.robot.tool import Tool
from sdf.base import SDF
from sdf.object_model import ObjectModel

PushChoice = Literal["auto", "displacement", "quasi-static", "mujoco"]
PUSH_MODELS: tuple[str, ...] = get_args(PushChoice)

# metres off upright or off a height at which a particle's outline is another
_LEVEL = 1e-3
# cosine of the tilt up to which an engine takes particles to be upright where the tool moves in space, and tilts them
_TILTED = math.cos(math.radians(15.0))


@dataclass(frozen=True)
class EngineSettings:
    """Settings of the push model that is a physics engine.

    Attributes:
        time_step_s: of the physics.
        action_s: duration of an action.
        hold_s: standing still after it.
        friction: of everything.
        mass_kg: of the object.
        threads: that step at once; 0 for as many as torch has. The rollouts are the same to the bit.
    """

    time_step_s: float = 0.005
    action_s: float = 1.0
    hold_s: float = 0.1
    friction: float = 0.5
    mass_kg: float = 0.35
    threads: int = 0

    def __post_init__(self) -> None:
        """Refuse what has no meaning."""
        for name in ("time_step_s", "action_s", "friction", "mass_kg"):
            if not getattr(self, name) > 0:
                raise ValueError(f"Expected {name} above 0, got {getattr(self, name)}")
        if self.hold_s < 0 or self.threads < 0:
            raise ValueError(f"Expected hold_s and threads to be 0 or more, got {self.hold_s} and {self.threads}")


Engine = Callable[[ObjectModel, Tensor, Tensor, Tool, EngineSettings], PushModel]
"""Makes the push model of a physics engine from object, poses, log-weights and tool."""

ENGINES: dict[str, Engine] = {}
"""Push models that know the simulator enter themselves here, since the algorithm does not know it."""


class PushModels:
    """Makes push models for the beliefs of a run; keeps what they need of the object's shape, which never changes.

    Args:
        choice: which member; "auto" is the quasi-static one for upright particles and a level tool, else displacement.
        displacement: settings of the displacement model.
        quasi_static: settings of the quasi-static model.
        engine: settings of a physics engine.
    """

    def __init__(
        self,
        choice: PushChoice = "displacement",
        displacement: DisplacementSettings | None = None,
        quasi_static: QuasiStaticSettings | None = None,
        engine: EngineSettings | None = None,
    ) -> None:
        if choice not in PUSH_MODELS:
            raise ValueError(f"Expected a push model out of {', '.join(PUSH_MODELS)}, got {choice!r}")
        self.choice = choice
        self.displacement = displacement or DisplacementSettings()
        self.quasi_static = quasi_static or QuasiStaticSettings()
        self.engine = engine or EngineSettings()
        self._shape: tuple[SDF, float, GridOutline, Support] | None = None

    def chosen(self, world_T_object: Float[Tensor, "N 4 4"], tool: Tool) -> str:
        """Name of the member that pushes these particles with this tool; "displacement" for what has been toppled."""
        if self.choice == "mujoco" and tool.spatial:
            return "mujoco" if bool((world_T_object[:, 2, 2] >= _TILTED).all()) else "displacement"
        if self.choice != "auto":
            return self.choice
        return "displacement" if tool.spatial or not stands(world_T_object) else "quasi-static"

    def of_belief(
        self,
        model: ObjectModel,
        world_T_object: Float[Tensor, "N 4 4"],
        log_weights: Float[Tensor, "N"],
        tool: Tool,
        workspace: Workspace,
        fields: WorkspaceFields,
    ) -> PushModel:
        """The push model of one scene.

        Raises:
            ValueError: if single poses are to be pushed, and they do not stand upright at one height.
            RuntimeError: if a physics engine is asked for that nothing has brought.
        """
        choice = self.chosen(world_T_object, tool)
        if choice == "displacement":
            contact = ContactField.from_belief(model.sdf, world_T_object, log_weights, workspace, fields)
            return DisplacementModel(contact, tool, self.displacement)
        height = 0.0 if tool.spatial and choice == "mujoco" else standing_height(world_T_object)
        if choice == "quasi-static":
            outline, support = self._shape_at(model.sdf, tool.height_m - height)
            return QuasiStaticModel(outline, support, tool, world_T_object, log_weights, self.quasi_static)
        if choice not in ENGINES:
            raise RuntimeError(
                f"Expected the push model {choice!r} to have been entered: import rumi.sim.push_model first"
            )
        return ENGINES[choice](model, world_T_object, log_weights, tool, self.engine)

    def _shape_at(self, sdf: SDF, height: float) -> tuple[GridOutline, Support]:
        known = self._shape
        if known is None or known[0] is not sdf or abs(known[1] - height) > _LEVEL:
            known = (sdf, height, GridOutline.of_slice(sdf, height), support_of(sdf))
            self._shape = known
        return known[2], known[3]


def stands(world_T_object: Float[Tensor, "N 4 4"]) -> bool:
    """Whether particles are upright and at one height, so that one outline is that of all."""
    heights = world_T_object[:, 2, 3]
    tilted = bool((world_T_object[:, 2, 2] < 1.0 - _LEVEL).any())
    return not tilted and float(heights.max() - heights.min()) <= _LEVEL


def standing_height(world_T_object: Float[Tensor, "N 4 4"]) -> float:
    """Z of the origin of particles that stand upright.

    Raises:
        ValueError: if they do not, or at different heights.
    """
    if not stands(world_T_object):
        raise ValueError(
            "Expected upright particles at one height to push one by one, got others: choose the push model "
            "'displacement'"
        )
    return float(world_T_object[:, 2, 3].mean())
