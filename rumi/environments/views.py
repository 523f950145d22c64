"""Observations of an environment: the belief as images or as particles, or the raw reading."""

from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from rumi.belief.particles import subsample
from rumi.fields.information import information_field
from rumi.records import StepRecord
from rumi.registry import Table
from rumi.task import StepResult
from rumi.tasks.rummage.agent import Rummager, RummageState
from sdf.extras import optional
from sensors.semantics import Semantics

if TYPE_CHECKING:
    from gymnasium import spaces
else:
    spaces = optional("gymnasium", "An environment").spaces

Observed = dict[str, np.ndarray]


@runtime_checkable
class View(Protocol):
    """What a policy sees after a step; of one size whatever was sensed. Made of an agent, the instants of a reading.

    Attributes:
        believes: whether it needs a belief.
        space: of what it gives.
    """

    believes: bool
    space: spaces.Dict

    def __init__(self, agent: Rummager, instants: int) -> None: ...

    def __call__(self, result: StepResult, state: RummageState | None) -> Observed:
        """What is seen.

        Args:
            result: of the task.
            state: of the agent after it; None where the view needs no belief.
        """
        ...


class ImageView:
    """The belief as images of the workspace: `fields` (4, X, Y, Z) has p(free), p(occupied), p(surface), information.

    Beside it `configuration` (Q), of the tool, and `expected_nll` (1), by which the belief judges itself.
    """

    believes = True

    def __init__(self, agent: Rummager, instants: int) -> None:
        self._agent, self._shape = agent, agent.workspace.shape
        self.space = spaces.Dict(
            {"fields": _box(4, *self._shape), "configuration": _box(len(agent.tool.scale)), "expected_nll": _box(1)}
        )

    def __call__(self, result: StepResult, state: RummageState | None) -> Observed:
        """The fields of the belief."""
        record = _believed(state)
        poses, log_weights = record.poses
        found = information_field(self._agent.model.sdf, poses, log_weights, self._agent.workspace.points)
        fields = torch.cat((found.semantics, found.information[:, None]), -1)
        return {
            "fields": _plain(fields.mT.reshape(4, *self._shape)),
            "configuration": _plain(result.reading.configuration),
            "expected_nll": np.array([record.expected_nll], np.float32),
        }


class ParticleView:
    """The belief as particles: `poses` (N, 4, 4) world_T_object and `weights` (N), 0 for those that are none.

    Beside it `configuration` (Q), of the tool, and `expected_nll` (1), by which the belief judges itself.
    """

    believes = True

    def __init__(self, agent: Rummager, instants: int) -> None:
        self._count = count = agent.initialise.particles
        self.space = spaces.Dict(
            {
                "poses": _box(count, 4, 4),
                "weights": _box(count),
                "configuration": _box(len(agent.tool.scale)),
                "expected_nll": _box(1),
            }
        )

    def __call__(self, result: StepResult, state: RummageState | None) -> Observed:
        """The particles of the belief."""
        record = _believed(state)
        few = subsample(record.belief, self._count)
        poses, weights = few.world_T_object, few.weights
        missing = self._count - len(weights)
        return {
            "poses": _plain(torch.cat((poses, poses[-1:].expand(missing, 4, 4)))),
            "weights": _plain(torch.cat((weights, weights.new_zeros(missing)))),
            "configuration": _plain(result.reading.configuration),
            "expected_nll": np.array([record.expected_nll], np.float32),
        }


class ReadingView:
    """The reading of the last action, no belief: where the tool was, which instants touched, and points with semantics.

    `tool_pose` (K, 4, 4), `in_contact` (K), `points` (512, 3) in the world, `semantics` (512) with -1 for padding, and
    `configuration` (Q). Surface points come first; of the others as many as there is room for, evenly.
    """

    believes = False
    points = 512

    def __init__(self, agent: Rummager, instants: int) -> None:
        self._instants = instants
        self.space = spaces.Dict(
            {
                "tool_pose": _box(instants, 4, 4),
                "in_contact": spaces.MultiBinary(instants),
                "points": _box(self.points, 3),
                "semantics": spaces.Box(-1, max(Semantics), (self.points,), np.int64),
                "configuration": _box(len(agent.tool.scale)),
            }
        )

    def __call__(self, result: StepResult, state: RummageState | None) -> Observed:
        """The parts of the reading."""
        reading, count = result.reading, len(result.reading.tool_pose)
        instant = torch.arange(self._instants).clamp_max(count - 1) + max(0, count - self._instants)
        seen = reading.observation
        surface = seen.of_class(Semantics.SURFACE)
        first = _evenly(surface.nonzero()[:, 0], self.points)
        chosen = torch.cat((first, _evenly((seen.valid & ~surface).nonzero()[:, 0], self.points - len(first))))
        points, semantics = torch.zeros(self.points, 3), torch.full((self.points,), -1)
        points[: len(chosen)], semantics[: len(chosen)] = (
            seen.points[chosen].cpu().float(),
            seen.semantics[chosen].cpu(),
        )
        return {
            "tool_pose": _plain(reading.tool_pose[instant]),
            "in_contact": reading.in_contact[instant].cpu().numpy().astype(np.int8),
            "points": _plain(points),
            "semantics": semantics.numpy(),
            "configuration": _plain(reading.configuration),
        }


VIEWS: Table[type[View]] = Table("view")
"""What an environment's observation may be, by name."""

VIEWS.add("image", ImageView)
VIEWS.add("particles", ParticleView)
VIEWS.add("reading", ReadingView)


def _box(*shape: int) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, shape, np.float32)


def _plain(values: Tensor) -> np.ndarray:
    return values.detach().to("cpu", torch.float32).numpy()


def _believed(state: RummageState | None) -> StepRecord:
    assert state is not None
    return state.record


def _evenly(index: Tensor, most: int) -> Tensor:
    """At most so many of some, spread evenly over them."""
    if len(index) <= most:
        return index
    return index[torch.linspace(0, len(index) - 1, most).long()]
