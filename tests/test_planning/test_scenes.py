"""Costs and plans of a batch of scenes: a row is what the scene gives alone."""

import pytest
import torch
from torch import Tensor

from kmppi import MPPI, MPPISettings, Rollouts
from rumi.dynamics.base import PushRollouts
from rumi.dynamics.registry import PushModels, PushSettings
from rumi.dynamics.scene_rollouts import SceneRollouts, stacked
from rumi.fields.information import information_field
from rumi.fields.workspace import Workspace
from rumi.planning.objective import TrajectoryCost, cost_of_scenes
from rumi.robot.tool import Tool
from sdf import se3
from sdf.containers import index
from sdf.object_model import ObjectModel, object_model
from sdf.primitives import Mug
from sdf.symmetry import Symmetries

F64 = torch.float64
HEIGHT, START = 0.045, torch.tensor([[0.28, 0.0, 0.0], [0.3, 0.02, 0.4], [0.33, -0.02, -0.3]], dtype=F64)
BOUNDS = torch.tensor([[0.1, -0.3, HEIGHT], [0.7, 0.3, HEIGHT]], dtype=F64)
WORKSPACE = Workspace.from_bounds(BOUNDS, 0.02, planar_height=HEIGHT)
TOOL = Tool(BOUNDS[:, :2], height_m=HEIGHT, body_spacing_m=0.01, info_spacing_m=0.01).double()
COSTS = {
    "both": {},
    "where it lies": {"displaced_information": False, "information_discount": 0.9},
    "information": {"reachability_scale": 0.0, "normalise": False},
    "reach": {"information_scale": 0.0, "reachability_scale": 3.0},
}

# every test of this file holds for the plain and for the compiled version
pytestmark = pytest.mark.usefixtures("version")


@pytest.fixture(scope="module")
def mug() -> ObjectModel:
    return object_model("mug", Mug(), Symmetries.none(), spacing=0.004, points=50).to(F64)


def beliefs(count: int = 3) -> tuple[Tensor, Tensor]:
    random = torch.Generator().manual_seed(2)
    spread = torch.tensor([0.01, 0.01, 0.8], dtype=F64) * torch.randn(count, 6, 3, generator=random, dtype=F64)
    poses = se3.from_planar(torch.tensor([0.4, 0.0, 0.3], dtype=F64) + spread)
    return poses, torch.randn(count, 6, generator=random, dtype=F64).log_softmax(-1)


def plan(mug: ObjectModel, name: str, rows: slice | int, **costs: float) -> tuple[Tensor, Rollouts, PushRollouts]:
    """Two iterations of KMPPI for all scenes, or for one."""
    poses, weights = (part[rows] for part in beliefs())
    random = [torch.Generator().manual_seed(row) for row in range(3)][rows]
    fields = information_field(mug.sdf, poses, weights, WORKSPACE.points)
    models = PushModels(PushSettings(push_model=name))
    model = models.rollouts(mug, poses, weights, TOOL, WORKSPACE, fields)
    reach, seen = WORKSPACE.grid((1.0 - WORKSPACE.points[:, 0]).clamp(0, 1)), TOOL.info
    batch = fields.information.ndim > 1
    grids = [WORKSPACE.grid(one) for one in (fields.information if batch else fields.information[None])]
    own = [TrajectoryCost(grid, reach, seen, **costs) for grid in grids]

    def objective(controls: Tensor) -> Tensor:
        found = model.rollout(START[rows], controls, rollouts=2, generator=random)
        return cost_of_scenes(own, found) if batch else own[0](found)

    mppi = MPPI(MPPISettings(horizon=3, knots=3, samples=8, temperature=0.1), 3, F64)
    best, samples = mppi.plan(mppi.initial(generator=random), objective, iterations=2, generator=random)
    return best.controls, samples, model.nominal_rollout(START[rows], best.controls)


@pytest.mark.parametrize(("name", "costs"), [*(("displacement", costs) for costs in COSTS), ("quasi-static", "both")])
def test_a_row_of_plans_is_the_scene_alone(mug: ObjectModel, name: str, costs: str) -> None:
    controls, samples, nominal = plan(mug, name, slice(None), **COSTS[costs])
    assert samples.costs.std(-1).min() > 0
    exact = {"atol": 1e-10, "rtol": 0.0}
    for row in range(3):
        own, alone, predicted = plan(mug, name, row, **COSTS[costs])
        torch.testing.assert_close(controls[row], own, **exact)
        torch.testing.assert_close(samples.costs[row], alone.costs, **exact)
        torch.testing.assert_close(nominal.displacements[row], predicted.displacements, **exact)


def test_costs_of_scenes_of_which_one_never_turns_are_those_of_each_alone(mug: ObjectModel) -> None:
    """An object that is moved without turns, whose sums are a table's alone, beside one that turns."""
    poses, weights = beliefs(2)
    fields = information_field(mug.sdf, poses, weights, WORKSPACE.points)
    random, controls = torch.Generator().manual_seed(0), torch.tensor([[[1.0, 0.1, 0.2]] * 4, [[0.9, -0.3, 0.0]] * 4])
    reach = WORKSPACE.grid(WORKSPACE.points[:, 0])
    models, costs = [], []
    for row, name in enumerate(("displacement", "quasi-static")):
        own = index(fields, row)
        made = PushModels(PushSettings(push_model=name))
        models.append(made.rollouts(mug, poses[row], weights[row], TOOL, WORKSPACE, own))
        costs.append(TrajectoryCost(WORKSPACE.grid(own.information), reach, TOOL.info))
    controls = controls.to(F64).expand(2, 2, 4, 3)
    together = SceneRollouts(models).rollout(START[:2], controls, rollouts=2, generator=random)
    found = cost_of_scenes(costs, together)
    assert together.turns is not None and together.touched.any(-1).all()
    for row in range(2):
        alone = models[row].rollout(START[row], controls[row], rollouts=2, generator=random)
        torch.testing.assert_close(found[row], costs[row](alone), atol=1e-12 if row == 0 else 0.0, rtol=0.0)
    with pytest.raises(ValueError, match="a cost for each of 2 scenes, got 1"):
        cost_of_scenes(costs[:1], together)
    with pytest.raises(ValueError, match="as many scenes as models, 1"):
        SceneRollouts(models[:1]).nominal_rollout(START[:2], controls[:, 0])
    assert stacked([index(together, 1)]).turns is not None
