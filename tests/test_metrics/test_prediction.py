"""Predicted against realised: against formulas spelt out, and against the planner's own predictions."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from kmppi import MPPISettings
from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterSettings, PoseFilter
from rumi.dynamics.displacement_rollouts import DisplacementSettings
from rumi.dynamics.registry import PushModels, PushSettings
from rumi.fields.information import InformationSettings, information_field
from rumi.fields.workspace import Workspace
from rumi.planning.policy import Plan, PlanRequest, Scene
from rumi.planning.rummaging import RummagingPolicy, RummagingSettings
from rumi.records import StepRecord
from rumi.robot.tool import Tool
from scripts.bench.prediction import (
    Predicted,
    Realised,
    Situation,
    actions,
    agreement,
    from_plan,
    information_gained,
    realised,
)
from sdf import se3
from sdf.object_model import ObjectModel, object_model
from sdf.primitives import Mug
from sdf.symmetry import Symmetries
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation
from sensors.semantics import Semantics
from tests.fixtures.readings import make_reading

HEIGHT = 0.045
START = torch.tensor([0.4, 0.0, 0.0])


@pytest.fixture(scope="module")
def mug() -> ObjectModel:
    return object_model("mug", Mug(), Symmetries.none(), spacing=0.004, points=60)


@pytest.fixture(scope="module")
def follower(mug: ObjectModel) -> PoseFilter:
    return PoseFilter(FilterSettings(), [Discrepancy(mug.sdf, mug.radius)], "SE(2)")


@pytest.fixture(scope="module")
def workspace() -> Workspace:
    return Workspace.from_bounds(torch.tensor([[0.0, -0.4, HEIGHT], [0.8, 0.4, HEIGHT]]), 0.02, planar_height=HEIGHT)


@pytest.fixture(scope="module")
def tool() -> Tool:
    return Tool(torch.tensor([[0.0, -0.4], [0.8, 0.4]]), height_m=HEIGHT, body_spacing_m=0.01, info_spacing_m=0.01)


def belief(count: int = 12) -> PoseBelief:
    random = torch.Generator().manual_seed(3)
    noise = torch.randn(count, 3, generator=random) * torch.tensor([0.003, 0.003, 1.0])
    return PoseBelief.uniform(se3.from_planar(START + noise))


def record(
    step: int,
    believed: PoseBelief,
    configuration: Tensor,
    *,
    added: Observation | None = None,
    plan: Plan | None = None,
    truth: Tensor | None = None,
    path: Tensor | None = None,
    motion: Tensor | None = None,
    expected_nll: float = 20.0,
) -> StepRecord:
    path = configuration[None] if path is None else path
    reading = make_reading(tool=se3.from_planar(path, HEIGHT), motion=motion, configuration=configuration)
    control = None if step == 0 else torch.zeros(3)
    rest = {"expected_nll": expected_nll, "fit": 0.0, "apc": 0.0, "ess": 1.0, "contacts": 0}
    return StepRecord(
        step=step,
        control=control,
        reading=reading,
        added=added or Observation.empty(),
        belief=believed,
        plan=plan,
        truth=truth,
        **rest,
    )


HERE = torch.tensor([0.2, 0.0, 0.0])


def test_information_gained_is_the_divergence(mug: ObjectModel, follower: PoseFilter) -> None:
    """Of the weights after the new points from those before, whatever the object's motion and resampling did."""
    prior = belief(5).reweighted(torch.tensor([0.4, 0.3, 0.2, 0.1, 1e-12]).log())
    # what would be inside of the second particle's handle is free
    outermost = mug.surface_points[mug.surface_points[:, 0].topk(2).indices]
    inside = outermost - 0.005 * mug.sdf(outermost).gradient
    points = Observation.of(se3.apply(prior.attached_T_object[1], inside), Semantics.FREE)
    after = record(1, belief(3).moved(se3.from_planar(torch.tensor([0.1, 0.0, 0.5]))), HERE, added=points)
    likelihood = np.exp(-2.0 * follower.discrepancy(prior.attached_T_object, points).double().numpy())
    p = prior.weights.double().numpy()
    q = p * likelihood / (p * likelihood).sum()
    expected = float((q * np.log(q / p)).sum())
    assert expected > 1e-3
    assert information_gained(prior, after, follower) == pytest.approx(expected, rel=1e-4)
    assert information_gained(prior, record(1, belief(), HERE), follower) == 0.0


def test_what_an_action_did(follower: PoseFilter) -> None:
    moved = se3.from_planar(torch.tensor([0.05, -0.02, 0.0]))
    start = se3.from_planar(START)
    steps = [
        record(0, belief(), HERE, truth=start),
        record(1, belief().moved(moved), HERE, truth=moved @ start, expected_nll=12.0),
    ]
    found = realised(steps, 1, follower)
    assert found.displacement_m == pytest.approx((0.05, -0.02, 0.0))
    assert found.drop == 8.0
    assert not found.touched
    # without the truth, as it was measured
    blind = [replace(step, truth=None) for step in steps]
    assert realised(blind, 1, follower).displacement_m == pytest.approx((0.05, -0.02, 0.0), abs=1e-6)
    assert list(actions(steps)) == [1]


@pytest.mark.parametrize("hazard", ["per_rollout", "per_mini_step"])
def test_predicts_what_the_planner_predicted(mug: ObjectModel, workspace: Workspace, tool: Tool, hazard: str) -> None:
    """The likeliest outcome of a plan's first action, asked for afterwards."""
    settings = RummagingSettings(
        mppi=MPPISettings(horizon=5, knots=3, samples=60, warmup_iterations=3, cost_scale="std", temperature=0.03),
        push_model="displacement",
        push=DisplacementSettings(hazard=hazard),
        reachability_scale=0.0,
        rollouts=2,
    )
    near = torch.tensor([0.4, 0.1, -1.57])
    scene = Scene(mug, workspace, tool, near)
    random = torch.Generator().manual_seed(0)
    plan = RummagingPolicy(None, settings).act(PlanRequest(belief(), scene, generator=random))
    told = from_plan([record(0, belief(), near), record(1, belief(), near, plan=plan)], 1)
    situation = Situation(record(0, belief(), near), mug, workspace, tool)
    push = PushModels(PushSettings("displacement", push=settings.push))
    asked = situation.predict(plan.controls[0], settings.information, push)
    assert asked.information == pytest.approx(told.information, rel=1e-5)
    assert asked.displacement_m == pytest.approx(told.displacement_m, abs=1e-6)
    assert asked.information > 0.1
    # the mean over some rollouts is near it
    mean = situation.predict(plan.controls[0], settings.information, push, rollouts=20, generator=random)
    assert 0.2 * asked.information < mean.information < 5 * asked.information
    # and another member of the family can be asked as well
    other = situation.predict(plan.controls[0], settings.information, PushModels(PushSettings("quasi-static")))
    assert math.isfinite(other.information)
    with pytest.raises(ValueError, match="Expected a generator"):
        situation.predict(plan.controls[0], settings.information, push, rollouts=2)


def test_swept_information(mug: ObjectModel, workspace: Workspace, tool: Tool) -> None:
    """What the field holds along the way that the tool took, as seen from the object."""
    settings, before = InformationSettings(), record(0, belief(), HERE)
    fields = information_field(
        mug.sdf, before.belief.world_T_object, before.belief.log_weights, workspace.points, settings
    )
    grid = workspace.grid(fields.information)
    path = torch.stack((torch.linspace(0.3, 0.4, 6), torch.linspace(0.0, 0.1, 6), torch.linspace(0.0, 0.5, 6)), -1)

    def cells(way: Tensor) -> float:
        index, inside = grid.nearest_index(tool.info_points(way).reshape(-1, 3))
        return sum(float(grid.values[tuple(cell)]) for cell in {tuple(c) for c in index[inside].tolist()})

    situation, still = Situation(before, mug, workspace, tool), se3.identity((6,))
    swept = situation.swept(record(1, belief(), path[-1], path=path, motion=still), settings)
    assert swept == pytest.approx(cells(path), rel=1e-4)
    assert swept > 0.3
    # an object that rides with the tool shows it nothing new
    poses = se3.from_planar(path, HEIGHT)
    ridden = situation.swept(record(1, belief(), path[-1], path=path, motion=poses @ se3.inverse(poses[:1])), settings)
    assert ridden == pytest.approx(cells(path[:1]), rel=1e-4)
    assert situation.swept(record(1, belief(), path[-1], path=path), settings) is None


def pair(information: float, gained: float, expected: float, true: float) -> tuple[Predicted, Realised]:
    return Predicted(information, (expected, 0.0, 0.0)), Realised(gained, 0.0, (0.0, true, 0.0), True)


def test_agreement() -> None:
    runs = [
        [pair(1.0, 10.0, 0.03, 0.04), pair(2.0, 20.0, 0.0, 0.0), pair(0.5, 5.0, 0.0, 0.01)],
        [],
        [pair(3.0, 30.0, 0.02, 0.0), pair(0.0, 0.0, 0.0, 0.0)],
    ]
    found = agreement(runs, resamples=50)
    assert (found.actions, found.runs) == (5, 2)
    assert found.information[0] == pytest.approx(1.0)
    # lengths (.03, 0, 0, .02, 0) and (.04, 0, .01, 0, 0), errors of the three moves .05, .01, .02
    assert found.error_m == pytest.approx(0.02)
    assert found.pushes == 0.5
    assert found.false_pushes == pytest.approx(1 / 3)
    ranks = np.corrcoef([5, 2, 2, 4, 2], [5, 2, 4, 2, 2])[0, 1]
    assert found.distance[0] == pytest.approx(ranks)
    none = agreement([[]])
    assert none.actions == 0
    assert math.isnan(none.error_m)
