"""Policy: the protocol of a planner, its request and its plan."""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from kmppi import ControlPlan
from rumi import seeding
from rumi.belief.particles import PoseBelief
from rumi.dynamics.push_posterior import PushPosterior
from rumi.fields.workspace import Workspace
from rumi.planning.sampled_paths import SampledPaths
from rumi.robot.tool import Tool
from sdf.object_model import ObjectModel
from sensors.observation import Observation
from sensors.reading import Reading


@dataclass(frozen=True)
class Scene:
    """Scene as a policy may know it beside the belief: nothing of the truth.

    Attributes:
        model: the object's shape.
        workspace: the lattice on which fields live.
        tool: the robot's body points and free-space motion, with its reach.
        configuration: (Q,), where the tool is now (planar: x, y, yaw; in space: x, y, z, yaw).
        observed: all points so far, attached ones in the object-attached frame; None where nobody keeps them.
        reading: the last one; None before the first.
        pushes: what was learnt of how the object slides; None for what the push model was made with.
    """

    model: ObjectModel
    workspace: Workspace
    tool: Tool
    configuration: Float[Tensor, "Q"]
    observed: Observation | None = None
    reading: Reading | None = None
    pushes: PushPosterior | None = None


@dataclass(frozen=True)
class Plan:
    """Plan of a policy: controls, the predicted path and a warm start for the next plan.

    Attributes:
        controls: (T, A) in [-1, 1], the next ones first.
        path: (T+1, Q), configurations that the policy predicts, the present one first.
        warm_start: the planner's nominal controls.
        fields: maps that the plan rests on, by name, on the workspace lattice (for figures).
        skipped: what was skipped, by name, and how much of the whole (0..1).
        timings_s: seconds by stage.
        info: plain values about the plan. Policies that predict say by `predicted_information` what each action is
            expected to gather anew (in the unit of the field that they plan on), and those that roll pushes out by
            `predicted_displacement` how far each is expected to move the object (metres, world axes), both for the
            likeliest rollout.
        samples: paths of some samples, for figures; None where none were drawn, or nobody kept them.
    """

    controls: Float[Tensor, "T A"]
    path: Float[Tensor, "T1 Q"]
    warm_start: ControlPlan | None = None
    fields: dict[str, Tensor] = field(default_factory=dict)
    skipped: dict[str, float] = field(default_factory=dict)
    timings_s: dict[str, float] = field(default_factory=dict)
    info: dict[str, Any] = field(default_factory=dict)
    samples: SampledPaths | None = None


@dataclass(frozen=True)
class PlanRequest:
    """The input of a policy's decision.

    Attributes:
        belief: one scene's belief (no batch axes).
        scene: what else is known.
        previous: the last plan, to warm-start from; None at the start.
        executed: how many controls of `previous` were carried out.
        budget_s: seconds that planning may take, or None for as long as it needs; the plan is the best that there was
            time for.
        generator: of the random draws; by default one of seed 0.
    """

    belief: PoseBelief
    scene: Scene
    previous: Plan | None = None
    _: KW_ONLY
    executed: int = 0
    budget_s: float | None = None
    generator: torch.Generator = field(default_factory=lambda: seeding.generator(0))


@runtime_checkable
class Policy(Protocol):
    """Policy: chooses the next controls from the belief; RUMI and every baseline is one."""

    def act(self, request: PlanRequest) -> Plan:
        """Plan from the belief."""
        ...


def act_scenes(policy: Policy, requests: Sequence[PlanRequest]) -> list[Plan]:
    """Plans of a batch of scenes, which may differ in all that a request tells; each is what it is alone, to the bit.

    One after the other: nine tenths of a plan are rollouts and costs, whose kernels take a scene as long among others
    as by itself. What a scene skips, and when it is late, is its own.

    Args:
        policy: that plans.
        requests: of each scene, with a generator of its own.

    Raises:
        ValueError: scenes share a generator, so that plans would hang on their order.
    """
    if len({id(request.generator) for request in requests}) < len(requests):
        raise ValueError("Expected a generator for each scene's request, got one that several share")
    return [policy.act(request) for request in requests]
