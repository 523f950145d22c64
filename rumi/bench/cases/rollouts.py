"""Predicting what motions of the tool do to the object."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from kmppi import MPPI, MPPISettings
from rumi.bench.case import Case, Setup, case
from rumi.bench.scenes import HEIGHT_M, FieldScene, mug_scene
from rumi.dynamics.base import PushRollouts
from rumi.dynamics.contact import ContactField
from rumi.dynamics.displacement_rollouts import DisplacementRollouts
from rumi.fields.information import information_field
from rumi.robot.tool import Tool
from rumi.seeding import split
from rumi.tasks.rummage.scenes import find_task, make_tool
from sdf.voxel_grid import VoxelGrid

ROLLOUTS = 5


@dataclass(frozen=True, eq=False)
class PushScene:
    """A tool beside an object that is known roughly, and where it may go.

    Attributes:
        information: the belief's field.
        field: where the tool would touch.
        model: the push model.
        tool: the tool.
        start: its configuration.
        controls: (K, H, 3), as the planner draws them.
        draws: (K, M, H, S), what decides on contact.
    """

    information: VoxelGrid
    field: ContactField
    model: DisplacementRollouts
    tool: Tool
    start: Float[Tensor, "3"]
    controls: Float[Tensor, "K H 3"]
    draws: Float[Tensor, "K M H S"]

    def roll_out(self) -> PushRollouts:
        """All rollouts."""
        return self.model.rollout_drawn(self.start, self.controls, self.draws)


def bench_tool(setup: Setup) -> Tool:
    """The tasks' gripper with the reach of its arm; a coarse free-flying one where all is tiny."""
    if setup.tiny:
        free = torch.tensor([[-5.0, -5.0], [5.0, 5.0]])
        return Tool(free, height_m=HEIGHT_M, body_spacing_m=0.02, info_spacing_m=0.02)
    return make_tool(find_task("mug-0"), cache_dir=setup.cache_dir).to(setup.device)


def push_scene(setup: Setup) -> PushScene:
    """The gripper a few centimetres before the mug, 500 sequences of 15 actions, each rolled out 5 times."""
    scene: FieldScene = mug_scene(setup)
    tool = bench_tool(setup)
    fields = information_field(scene.model.sdf, scene.world_T_object, scene.log_weights, scene.points)
    field = ContactField.from_belief(scene.model.sdf, scene.world_T_object, scene.log_weights, scene.workspace, fields)
    model = DisplacementRollouts(field, tool)
    settings = MPPISettings(samples=setup.size(500, 12), horizon=setup.size(15, 4), knots=setup.size(8, 3))
    mppi = MPPI(settings, 3, device=setup.device)
    random = split(0, "bench/push")
    knots = 1.5**0.5 * torch.randn(settings.samples, mppi.parameterization.knots, 3, generator=random)
    controls = mppi.controls(knots.clamp(-1.0, 1.0).to(setup.device))
    draws = model.draw(settings.samples, ROLLOUTS, settings.horizon, generator=random)
    start = torch.tensor([0.33, 0.02, 0.1], device=setup.device)
    return PushScene(scene.workspace.grid(fields.information), field, model, tool, start, controls, draws)


def share_that_differs(found: tuple[Tensor, ...], reference: tuple[Tensor, ...]) -> float:
    """Share of the rollouts whose tool or object ends up elsewhere, by over 10 micrometres (or radians)."""
    same = torch.ones(len(reference[0]), dtype=torch.bool, device=reference[0].device)
    for a, b in zip(found, reference, strict=True):
        same &= (a - b).abs().amax((-1, -2)) < 1e-5
    return 1.0 - float(same.double().mean())


@case("rollouts")
def rollouts(setup: Setup) -> Case:
    """Push rollouts."""
    scene = push_scene(setup)

    def run() -> tuple[Tensor, Tensor]:
        result = scene.roll_out()
        return result.configurations.flatten(0, 1), result.displacements.flatten(0, 1)

    once = scene.roll_out()
    samples, count, horizon, _ = scene.draws.shape
    mini, points = scene.model.settings.mini_steps, len(scene.tool.body)
    return Case(
        f"push rollouts: {samples} x {count} of {horizon} actions x {mini} mini steps x {points} points",
        setup.ours(run),
        items=samples * count,
        item="rollout",
        error=share_that_differs,
        # in float32 the last digit of a probability may fall on the other side of a number that was drawn
        tolerance=5e-3,
        facts={
            "error": "share of rollouts with another outcome for the same draws",
            "rollouts that touch": round(float(once.touched.double().mean()), 3),
            "contact checks done point by point": round(float(once.checked), 3),
        },
    )
