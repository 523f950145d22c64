"""Rollouts of a batch of scenes, each by a push model of its own."""

from collections.abc import Sequence
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.base import PushRollouts, RolloutModel
from rumi.seeding import Generators


class SceneRollouts:
    """Push models of a batch of scenes as one: a `RolloutModel` with the scenes' axis in front.

    A scene is rolled out by its own model alone, one after the other, so that a row is what the model gives, to the
    bit: compiled rollouts of several scenes at once would take as long. Scenes may hold different objects, and push
    them by different members.

    Args:
        models: of each scene.

    Raises:
        ValueError: there are none.
    """

    def __init__(self, models: Sequence[RolloutModel]) -> None:
        if not models:
            raise ValueError("Expected the push model of one scene or more, got none")
        self.models = tuple(models)

    def rollout(
        self,
        configuration: Float[Tensor, "B Q"],
        controls: Float[Tensor, "B K H A"],
        *,
        rollouts: int,
        generator: Generators,
    ) -> PushRollouts:
        """Roll the control sequences of each scene out; see `RolloutModel.rollout`.

        Args:
            configuration: where each robot is now.
            controls: of each scene, in [-1, 1].
            rollouts: M, how often to draw each sequence.
            generator: one a scene; of one for all a scene's draws follow on those of the scene before.
        """
        self._check(configuration, controls)
        random = [generator] * len(self.models) if isinstance(generator, torch.Generator) else generator
        each = zip(self.models, configuration, controls, random, strict=True)
        return stacked([model.rollout(q, own, rollouts=rollouts, generator=one) for model, q, own, one in each])

    def nominal_rollout(self, configuration: Float[Tensor, "B Q"], controls: Float[Tensor, "B H A"]) -> PushRollouts:
        """The one rollout (K = M = 1) of each scene that is shown as its plan."""
        self._check(configuration, controls)
        each = zip(self.models, configuration, controls, strict=True)
        return stacked([model.nominal_rollout(q, own) for model, q, own in each])

    def coarse(self) -> Self:
        """The quicker models of the same scenes."""
        return type(self)([model.coarse() for model in self.models])

    def _check(self, configuration: Tensor, controls: Tensor) -> None:
        if not len(configuration) == len(controls) == len(self.models):
            raise ValueError(
                f"Expected configuration and controls of as many scenes as models, {len(self.models)}, "
                f"got {tuple(configuration.shape)} and {tuple(controls.shape)}"
            )


def stacked(scenes: Sequence[PushRollouts]) -> PushRollouts:
    """Rollouts of scenes along a new first axis; an object that never turns has turns of 0 where another's may."""
    turns, pivot = None, None
    if any(scene.turns is not None for scene in scenes):
        none = scenes[0].displacements
        turns = torch.stack([none.new_zeros(none.shape[:-1]) if one.turns is None else one.turns for one in scenes])
        pivot = torch.stack([none.new_zeros(2) if one.pivot is None else one.pivot for one in scenes])
    return PushRollouts(
        torch.stack([scene.configurations for scene in scenes]),
        torch.stack([scene.displacements for scene in scenes]),
        torch.stack([scene.contact for scene in scenes]),
        sum(scene.checked for scene in scenes) / len(scenes),
        torch.stack([scene.duplicate_of for scene in scenes]),
        turns,
        pivot,
    )
