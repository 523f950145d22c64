"""The family of push models by name, each made for one belief."""

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
from rumi.planning.tool import Tool
from sdf.base import SDF

PushChoice = Literal["displacement", "quasi-static"]
PUSH_MODELS: tuple[str, ...] = get_args(PushChoice)

# metres off upright or off a height at which a particle's outline is another
_LEVEL = 1e-3


class PushModels:
    """Makes push models for the beliefs of a run; keeps what they need of the object's shape, which never changes.

    Args:
        choice: which member.
        displacement: settings of the displacement model.
        quasi_static: settings of the quasi-static model.
    """

    def __init__(
        self,
        choice: PushChoice = "displacement",
        displacement: DisplacementSettings | None = None,
        quasi_static: QuasiStaticSettings | None = None,
    ) -> None:
        if choice not in PUSH_MODELS:
            raise ValueError(f"Expected a push model out of {', '.join(PUSH_MODELS)}, got {choice!r}")
        self.choice = choice
        self.displacement = displacement or DisplacementSettings()
        self.quasi_static = quasi_static or QuasiStaticSettings()
        self._shape: tuple[SDF, float, GridOutline, Support] | None = None

    def of_belief(
        self,
        sdf: SDF,
        world_T_object: Float[Tensor, "N 4 4"],
        log_weights: Float[Tensor, "N"],
        tool: Tool,
        workspace: Workspace,
        fields: WorkspaceFields,
    ) -> PushModel:
        """The push model of one scene.

        Raises:
            ValueError: if the quasi-static model is asked for particles that do not stand upright at one height.
        """
        if self.choice == "displacement":
            contact = ContactField.from_belief(sdf, world_T_object, log_weights, workspace, fields)
            return DisplacementModel(contact, tool, self.displacement)
        outline, support = self._shape_at(sdf, tool.height_m - _standing_height(world_T_object))
        return QuasiStaticModel(outline, support, tool, world_T_object, log_weights, self.quasi_static)

    def _shape_at(self, sdf: SDF, height: float) -> tuple[GridOutline, Support]:
        known = self._shape
        if known is None or known[0] is not sdf or abs(known[1] - height) > _LEVEL:
            known = (sdf, height, GridOutline.of_slice(sdf, height), support_of(sdf))
            self._shape = known
        return known[2], known[3]


def _standing_height(world_T_object: Float[Tensor, "N 4 4"]) -> float:
    """Z of the origin of particles that stand upright."""
    heights = world_T_object[:, 2, 3]
    tilted = bool((world_T_object[:, 2, 2] < 1.0 - _LEVEL).any())
    if tilted or float(heights.max() - heights.min()) > _LEVEL:
        raise ValueError(
            "Expected upright particles at one height for the quasi-static push model, got others: choose "
            "the push model 'displacement'"
        )
    return float(heights.mean())
