"""Quasi-static pushing as a push model: rollouts, pushes along a path, motion."""

import copy
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Self

from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.along_path import PathMotion, PathPush, push_along_path
from rumi.dynamics.base import LEVEL_M, PushDefaults, PushModel, Stance
from rumi.dynamics.outline import GridOutline, Support, support_of
from rumi.dynamics.push_posterior import PushPosterior, push_posterior
from rumi.dynamics.quasi_static import QuasiStaticRollouts, QuasiStaticSettings
from rumi.fields.information import WorkspaceFields
from rumi.fields.workspace import Workspace
from rumi.robot.tool import Tool
from rumi.robot.tool_shape import ToolShape
from sdf.base import SDF
from sdf.object_model import ObjectModel


class QuasiStaticPush(PushModel):
    """Slow pushing of single poses, which slide and turn: a `PushModel` of upright objects and a level tool.

    Keeps what it needs of the object's shape, which does not change in a run, and how the particles stand that it was
    asked about last, so that a plan takes one copy from a GPU for it: the one by which the model is chosen.

    Args:
        settings: friction, limit surface and mini steps of a push.
        posterior: over friction and limit surface, in place of the settings' own.
    """

    defaults = PushDefaults(reachability_scale=4.0, rollouts=8, least_share=0.03)
    objects = "planar"

    def __init__(self, settings: QuasiStaticSettings, posterior: PushPosterior | None = None) -> None:
        self.settings, self.posterior = settings, posterior
        self._shape: tuple[SDF, float, GridOutline, Support] | None = None
        self._stance: tuple[Tensor, int, Stance] | None = None

    @classmethod
    def make(cls, settings: Any) -> Self:  # noqa: ANN401
        """The model that settings describe."""
        return cls(settings.quasi_static, push_posterior(settings.push_parameters, settings.quasi_static.friction))

    def knowing(self, pushes: PushPosterior) -> Self:
        """The same model with another posterior; what it keeps of shapes is shared."""
        other = copy.copy(self)
        other.posterior = pushes
        return other

    def fits(self, world_T_object: Float[Tensor, "*b N 4 4"], tool: Tool) -> bool:
        """Whether the tool is level and all particles stand upright at one height."""
        return not tool.spatial and self._stance_of(world_T_object).rests

    def takes_scenes(self, world_T_object: Float[Tensor, "B N 4 4"]) -> bool:
        """Whether all scenes hold the object at one height, whose slice is that of each."""
        return len({Stance.of(poses).checked().height_m for poses in world_T_object}) == 1

    def rollouts(
        self,
        model: ObjectModel,
        world_T_object: Float[Tensor, "*b N 4 4"],
        log_weights: Float[Tensor, "*b N"],
        tool: Tool,
        workspace: Workspace,
        fields: WorkspaceFields,
    ) -> QuasiStaticRollouts:
        """Rollouts under one belief, or those of several scenes.

        Raises:
            ValueError: particles do not stand upright at one height.
        """
        outline, support = self._shape_at(model.sdf, tool.height_m - self._stance_of(world_T_object).checked().height_m)
        return QuasiStaticRollouts(outline, support, tool, world_T_object, log_weights, self.settings, self.posterior)

    def path(self, scene: Callable[[], Any] | None = None) -> PathPush:
        """Pushes along given paths."""
        return push_along_path

    def motion(self, model: ObjectModel, shape: ToolShape, height_m: float, resting_m: float) -> PathMotion:
        """Motion along the path of a level tool."""
        own = self.settings
        motion = PathMotion.of(
            model.sdf,
            height_m - resting_m,
            shape,
            push_along_path,
            spacing_m=own.spacing_m,
            lever_ratio=own.lever_ratio,
            friction=own.friction,
        )
        if self.posterior is None:
            return motion
        return replace(motion, sliding=self.posterior.middle(support_of(model.sdf)))

    def _stance_of(self, world_T_object: Float[Tensor, "*b N 4 4"]) -> Stance:
        known, version = self._stance, 0 if world_T_object.is_inference() else world_T_object._version
        if known is None or known[0] is not world_T_object or known[1] != version:
            known = self._stance = (world_T_object, version, Stance.of(world_T_object))
        return known[2]

    def _shape_at(self, sdf: SDF, height: float) -> tuple[GridOutline, Support]:
        known = self._shape
        if known is None or known[0] is not sdf or abs(known[1] - height) > LEVEL_M:
            known = (sdf, height, GridOutline.of_slice(sdf, height), support_of(sdf).cpu())
            self._shape = known
        return known[2], known[3]
