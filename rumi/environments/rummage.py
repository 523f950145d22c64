"""Gymnasium environment of a rummaging task."""

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from torch import Tensor

from rumi.api import build
from rumi.cache import cache_folder
from rumi.clock import Clock
from rumi.environments.views import VIEWS, Observed, View
from rumi.metrics.pose_error import pose_error
from rumi.task import StepResult
from rumi.tasks.rummage.agent import Rummager, RummageState
from rumi.tasks.rummage.scenes import find_task
from rumi.tasks.rummage.settings import Settings, preset
from sdf import se3, so3
from sdf.extras import optional
from sdf.symmetry import Symmetries

if TYPE_CHECKING:
    import gymnasium
    from gymnasium import spaces
else:
    gymnasium = optional("gymnasium", "An environment")
    spaces = gymnasium.spaces


class PoseLoss:
    """Loss of a predicted pose: metres off over 0.1 m plus radians off over half a turn, modulo the symmetries.

    Predictions and targets are (*b, 6): place, metres, and rotation vector, radians. It has a gradient in tensors.
    """

    def __init__(self, symmetries: Symmetries) -> None:
        self.symmetries = symmetries.to(torch.float64)

    def __call__(self, prediction: Any, target: Any, batch_shape: tuple[int, ...] = (), rng: object = None) -> Any:  # noqa: ANN401
        """Loss (*b) of each prediction: a tensor of a tensor, else an array.

        Args:
            prediction: (*b, 6).
            target: (*b, 6).
            batch_shape: of both, as active perception tasks give it; their own counts.
            rng: not used.
        """
        guess = torch.as_tensor(prediction)
        goal = torch.as_tensor(target, dtype=torch.float64)
        found, true = pose_of(torch.stack(torch.broadcast_tensors(guess.double(), goal)))
        metres, radians = pose_error(found, true, self.symmetries)
        loss = (metres / 0.1 + radians / math.pi).to(guess.dtype)
        return loss if isinstance(prediction, Tensor) else loss.numpy()


def pose_of(vector: Tensor) -> Tensor:
    """World pose (*b, 4, 4) of a place and a rotation vector (*b, 6)."""
    return se3.make(so3.exp(vector[..., 3:]), vector[..., :3])


def vector_of(pose: Tensor) -> Tensor:
    """Place and rotation vector (*b, 6) of a world pose."""
    return torch.cat((pose[..., :3, 3], so3.log(pose[..., :3, :3])), -1)


class RummageEnv(gymnasium.Env[Observed, Any]):
    """Rummaging task as an environment: the parts of `rumi.loop.run` with the actions chosen from outside.

    A control is (dx, dy, dyaw) or (dx, dy, dz, dyaw), each in [-1, 1]. A step carries it out and updates the belief;
    the reward is by how much the belief's own expected nll dropped. An episode terminates when the belief is sure, and
    is truncated after the task's actions. `reset(seed=s)` is the scene of `rumi run TASK --seed s`.

    With `predicts` it is an active perception task: an action is {"action", "prediction"}, the prediction a pose as
    place and rotation vector (6), `loss_fn` its differentiable loss, and the reward less that loss
    (`info["prediction"]` has target and loss). Truth is in `info` alone.

    Args:
        task: name of a rummaging task.
        view: what is observed, "image", "particles" or "reading"; the last keeps no belief.
        predicts: whether an action brings a prediction; by default where there is no belief, which gives no reward.
        preset: where the settings start from.
        cache_dir: folder that keeps what takes seconds to work out; by default `rumi`'s own.
        changes: settings to give another value, such as `steps`.

    Raises:
        UsageError: there is no such task, view, preset or setting.
    """

    def __init__(
        self,
        task: str,
        *,
        view: str = "image",
        predicts: bool | None = None,
        preset: str = "default",
        cache_dir: Path | None = None,
        render_mode: None = None,
        **changes: Any,  # noqa: ANN401  (values of the settings)
    ) -> None:
        self.settings = _settings(task, preset, changes)
        kind = VIEWS[view]
        parts = build(self.settings, cache_dir=cache_folder() if cache_dir is None else cache_dir)
        self.task, agent = parts
        self.agent: Rummager = replace(agent, remarks=False)  # which nobody reads here
        self.view: View = kind(agent, self.settings.simulator.mini_steps)
        self.predicts = not self.view.believes if predicts is None else predicts
        self.observation_space = cast(Any, self.view.space)
        self.inner_action_space = spaces.Box(-1.0, 1.0, (len(agent.tool.scale),), np.float32)
        self.prediction_target_space = self.prediction_space = spaces.Box(-np.inf, np.inf, (6,), np.float32)
        self.loss_fn = PoseLoss(agent.model.symmetries)
        self.action_space: spaces.Space[Any] = self.inner_action_space
        if self.predicts:
            self.action_space = spaces.Dict({"action": self.inner_action_space, "prediction": self.prediction_space})
        self.state: RummageState | None = None
        self.steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """A new scene: of the seed, or of one drawn from the seed of before."""
        super().reset(seed=seed)
        own = int(self.np_random.integers(2**31)) if seed is None else seed
        result = StepResult.of(self.task.reset(own))
        self.steps, self.state = 0, None
        with torch.no_grad():
            if self.view.believes:
                self.state = self.agent.begin(result.reading, seed=own, clock=Clock())
            observed = self.view(result, self.state)
        info = self._info(result)
        if self.predicts:
            info["prediction"] = {"target": self._target(result)}
        return observed, info

    def step(self, action: Any) -> tuple[Observed, float, bool, bool, dict[str, Any]]:  # noqa: ANN401  (of the space)
        """Carry out a control, sense, update the belief."""
        control = torch.as_tensor(np.asarray(action["action"] if self.predicts else action), dtype=torch.float32)
        result = StepResult.of(self.task.step(control))
        self.steps += 1
        reward, sure, before = 0.0, False, self.state
        with torch.no_grad():
            if before is not None:
                self.state = state = self.agent.update(before, control, result.reading)
                reward = before.record.expected_nll - state.record.expected_nll
                sure = self.agent.stop(state) == "sure"
            observed = self.view(result, self.state)
        info = self._info(result)
        if self.predicts:
            target = self._target(result)
            loss = self.loss_fn(np.asarray(action["prediction"], np.float32), target)
            info |= {"base_reward": reward, "prediction": {"target": target, "loss": loss}}
            reward -= float(loss)
        ended = self.agent.steps is not None and self.steps >= self.agent.steps
        return observed, float(reward), sure, ended and not sure, info

    def close(self) -> None:
        """Let go of the simulator."""
        self.task.close()

    def _info(self, result: StepResult) -> dict[str, Any]:
        truth = torch.full((4, 4), math.nan) if result.truth is None else result.truth
        told: dict[str, Any] = {"truth": truth.cpu().float().numpy()}
        if self.state is not None:
            record = self.state.record
            told |= {"expected_nll": record.expected_nll, "contacts": record.contacts}
        return told

    def _target(self, result: StepResult) -> np.ndarray:
        assert result.truth is not None
        return vector_of(result.truth.cpu().double()).float().numpy()


def _settings(task: str, name: str, changes: dict[str, Any]) -> Settings:
    find_task(task)
    return preset(name, task=task, **changes)
