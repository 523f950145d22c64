"""GPVR: its cost against sums spelt out, its data against what was observed, its plans against where variance is."""

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from kmppi import MPPISettings
from rumi.belief.particles import PoseBelief
from rumi.clock import SimulatedClock
from rumi.dynamics.base import PushRollouts
from rumi.dynamics.displacement_rollouts import DisplacementSettings
from rumi.fields.information import information_field
from rumi.fields.workspace import Workspace
from rumi.planning import gpvr
from rumi.planning.gpvr import GPVRPolicy, GPVRSettings, VarianceCost
from rumi.planning.policy import Plan, PlanRequest, Scene
from rumi.planning.rummaging import RummagingSettings
from rumi.robot.tool import Tool
from sdf import se3
from sdf.object_model import ObjectModel, object_model
from sdf.primitives import Mug
from sdf.symmetry import Symmetries
from sdf.voxel_grid import VoxelGrid
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics

gpytorch = pytest.importorskip("gpytorch")

HEIGHT = 0.045
PLANNER = RummagingSettings(
    mppi=MPPISettings(horizon=6, knots=4, samples=80, warmup_iterations=4, temperature=0.03, cost_scale="std"),
    push=DisplacementSettings(mini_steps=2),
    rollouts=2,
)


# every test of this file holds for the plain and for the compiled version
pytestmark = pytest.mark.usefixtures("version")


@pytest.fixture(scope="module")
def mug() -> ObjectModel:
    return object_model("mug", Mug(), Symmetries.none(), spacing=0.004, points=150)


@pytest.fixture
def scene(mug: ObjectModel) -> Scene:
    workspace = Workspace.from_bounds(
        torch.tensor([[0.0, -0.4, HEIGHT], [0.8, 0.4, HEIGHT]]), 0.02, planar_height=HEIGHT
    )
    tool = Tool(torch.tensor([[0.0, -0.4], [0.8, 0.4]]), height_m=HEIGHT, body_spacing_m=0.02, info_spacing_m=0.01)
    near = mug.surface_points[mug.surface_points[:, 0] < 0]
    observed = concatenate([Observation.of(near, Semantics.SURFACE), Observation.of(near * 3.0, Semantics.FREE)])
    return Scene(mug, workspace, tool, torch.tensor([0.2, 0.0, 0.0]), observed=observed)


def believed(spread: float = 1.0) -> PoseBelief:
    """Of a mug that was observed at the origin and has moved 0.4 m since."""
    random = torch.Generator().manual_seed(3)
    yaw = spread * torch.randn(12, 1, generator=random)
    belief = PoseBelief.uniform(se3.from_planar(torch.cat((torch.zeros(12, 2), yaw), -1)))
    return belief.moved(se3.from_planar(torch.tensor([0.4, 0.0, 0.0])))


def act(scene: Scene, gp: GPVRSettings | None = None, previous: Plan | None = None, *, greedy: bool = False) -> Plan:
    policy = GPVRPolicy(PLANNER, gp or GPVRSettings(max_points=60), greedy=greedy)
    random = torch.Generator().manual_seed(0)
    return policy.act(PlanRequest(believed(), scene, previous, executed=1, generator=random))


@pytest.fixture(scope="module")
def planned() -> Callable[[Scene, str], Plan]:
    """A plan by a version, made once."""
    made: dict[str, Plan] = {}

    def plan(scene: Scene, version: str) -> Plan:
        if version not in made:
            made[version] = act(scene)
        return made[version]

    return plan


def random_rollouts(generator: torch.Generator, samples: int = 6, count: int = 3, horizon: int = 4) -> PushRollouts:
    shape = (samples, count, horizon + 1, 3)
    q = torch.randn(shape, generator=generator) * torch.tensor([0.3, 0.3, 2.0])
    d = 0.1 * torch.randn(shape, generator=generator) * torch.tensor([1.0, 1.0, 0.0])
    q[:, :, 2] = q[:, :, 1]  # a step that stands still
    d[:, :, 2] = d[:, :, 1]
    duplicate_of = torch.arange(count).repeat(samples, 1)
    q[0, 2], d[0, 2], duplicate_of[0, 2] = q[0, 1], d[0, 1], 1
    return PushRollouts(q, d, torch.zeros(samples, count, horizon, dtype=torch.bool), 1.0, duplicate_of)


def test_cost_sums_each_steps_own_cells(generator: torch.Generator) -> None:
    """A cell met at two steps counts twice, at one step by two points once."""
    field = VoxelGrid(torch.rand(14, 12, 1, generator=generator), torch.tensor([-0.3, -0.25, 0.0]), 0.04)
    tool = Tool(torch.tensor([[0.0, -0.4], [0.8, 0.4]]), height_m=HEIGHT, info_spacing_m=0.015)
    points = tool.info
    rollouts, beta = random_rollouts(generator), 0.9
    expected = torch.zeros(6)
    for k in range(6):
        for m in range(3):
            for t in range(1, 5):
                world = se3.apply(se3.from_planar(rollouts.configurations[k, m, t]), points)
                index, inside = field.nearest_index(world - rollouts.displacements[k, m, t])
                cells = {tuple(c) for c, held in zip(index.tolist(), inside.tolist(), strict=True) if held}
                expected[k] -= beta ** (t - 1) * sum(float(field.values[c]) for c in cells) / 3
    assert float(expected.min()) < -0.5
    torch.testing.assert_close(VarianceCost(field, tool, beta)(rollouts), expected, atol=1e-4, rtol=1e-4)


def test_golden_cost(golden: Callable[[str], dict[str, Any]]) -> None:
    """Cells of a metre, so that the tool meets the two on whose border it is at each step."""
    case = golden("rumi.eq37")
    variance = torch.tensor(case["inputs"]["var"], dtype=torch.float64)
    field = VoxelGrid(variance.reshape(6, 1, 1), torch.zeros(3), 1.0)
    tool = Tool(torch.tensor([[0.0, -0.4], [0.8, 0.4]]), height_m=0.0)
    middle = float(tool.info[:, 0].amin() + tool.info[:, 0].amax()) / 2
    q = torch.zeros(1, 1, 4, 3, dtype=torch.float64)
    q[0, 0, 1:, 0] = torch.tensor([0.5, 2.5, 4.5]) - middle
    still = torch.zeros_like(q)
    rollouts = PushRollouts(q, still, torch.zeros(1, 1, 3, dtype=torch.bool), 1.0, torch.zeros(1, 1, dtype=torch.long))
    cost = VarianceCost(field, tool, case["inputs"]["beta"])(rollouts)
    assert float(cost) == pytest.approx(case["expected"]["total"], abs=1e-9)


def test_data_are_what_was_observed_and_what_is_free_for_sure(scene: Scene) -> None:
    policy, belief = GPVRPolicy(PLANNER, GPVRSettings(max_points=0)), believed()
    fields = information_field(
        scene.model.sdf, belief.world_T_object, belief.log_weights, scene.workspace.points, PLANNER.information
    )
    data = policy.data(belief, scene, fields)
    surface, free = data.points[data.labels == 0], data.points[data.labels == 1]
    # all surface points, in the world where the mug is now
    seen = scene.observed.points[scene.observed.semantics == int(Semantics.SURFACE)]
    torch.testing.assert_close(surface.float(), seen + torch.tensor([0.4, 0.0, 0.0]))
    # free ones: about one for each node of a lattice of 7 spacings, none where the object may be
    assert 40 < len(free) <= (6 + 1) ** 2 + 30
    assert float((torch.cdist(free, free) + torch.eye(len(free))).min()) > 0.02
    lattice = scene.workspace.points
    doubtful = lattice[fields.semantics[:, 0] <= 0.99].double()
    assert len(doubtful) > 10
    own = free[free[:, 2] == float(lattice[0, 2])]
    assert float(torch.cdist(own, doubtful).min()) > 0.01


def test_variance_is_normalised_and_least_where_much_is_known(
    scene: Scene, version: str, planned: Callable[[Scene, str], Plan]
) -> None:
    plan = planned(scene, version)
    variance = plan.fields["variance"]
    assert float(variance.max()) == pytest.approx(1.0)
    assert float(variance.min()) >= 0.0
    grid = scene.workspace.grid(variance)
    known, unknown = torch.tensor([[0.36, 0.0, HEIGHT]]), torch.tensor([[0.48, 0.0, HEIGHT]])
    assert float(grid.interpolate(known)) < 0.5 * float(grid.interpolate(unknown))


def test_hyperparameters_go_on_from_the_last_plan(scene: Scene) -> None:
    first = act(scene, GPVRSettings(refit_steps=20, max_points=60))
    kept = act(scene, GPVRSettings(refit_steps=0, max_points=60), first)
    assert kept.info["gp_hyperparameters"] == first.info["gp_hyperparameters"]
    later = act(scene, GPVRSettings(refit_steps=20, max_points=60, tolerance=0.0), first)
    assert later.info["gp_hyperparameters"] != first.info["gp_hyperparameters"]
    assert first.info["gp_points"] == 60


def met(plan: Plan, scene: Scene) -> Tensor:
    """Variance that each position of the path meets."""
    cost = VarianceCost(scene.workspace.grid(plan.fields["variance"]), scene.tool, 1.0)
    return -cost.of_paths(plan.path[:, None], torch.zeros(len(plan.path), 1, 3))


def test_plans_meet_more_variance_than_others(
    scene: Scene, version: str, planned: Callable[[Scene, str], Plan]
) -> None:
    """More than standing still, and than most of some hundred random plans, in free motion."""
    plan = planned(scene, version)
    values = met(plan, scene)
    assert float(values[1:].mean()) > float(values[0])
    others = 2.0 * torch.rand(300, 6, 3, generator=torch.Generator().manual_seed(5)) - 1.0
    paths = scene.tool.free_path(scene.configuration.expand(300, 3), others, 1)
    cost = VarianceCost(scene.workspace.grid(plan.fields["variance"]), scene.tool, 1.0)
    assert float(values[1:].sum()) > float((-cost.of_paths(paths, torch.zeros(300, 6, 3))).quantile(0.75))


def test_greedy_takes_the_best_next_position(scene: Scene) -> None:
    plan = act(scene, greedy=True)
    assert plan.controls.shape == (1, 3)
    # no position that some hundred other controls lead to is much better
    others = 2.0 * torch.rand(300, 3, generator=torch.Generator().manual_seed(5)) - 1.0
    cost = VarianceCost(scene.workspace.grid(plan.fields["variance"]), scene.tool, 1.0)
    reached, _ = scene.tool.free_step(scene.configuration, others)
    values = -cost.of_paths(reached[:, None], torch.zeros(300, 1, 3))
    chosen = float(met(plan, scene)[1])
    assert chosen >= float(values.quantile(0.95))
    assert chosen > float(values.median())
    # and it starts anew each time
    again = act(scene, GPVRSettings(refit_steps=0, max_points=60), plan, greedy=True)
    assert again.controls.shape == (1, 3)


def test_refuses_what_has_no_meaning(scene: Scene) -> None:
    with pytest.raises(ValueError, match=r"Expected scene\.observed"):
        act(replace(scene, observed=None))


# what a process does in its time hangs on the clock alone: the compiled version, which plans twenty times as fast
in_time = pytest.mark.parametrize("version", ["numba"], indirect=True)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimulatedClock:
    """Told of a process's work: 2 us a covariance for the variance and 1 us for a step, and 4 ms for a first step."""
    clock = SimulatedClock()
    variance, fit = gpvr.predictive_variance, gpvr.fit

    def slow_variance(data: gpvr.Labelled, *rest: Any) -> Tensor:
        clock.advance(2e-6 * len(data.points) ** 2)
        return variance(data, *rest)

    def slow_fit(data: gpvr.Labelled, *rest: Any, steps: int, should_stop: Callable[[], bool], **more: Any) -> Any:
        def stop() -> bool:
            clock.advance(1e-6 * len(data.points) ** 2)
            return should_stop is not None and should_stop()

        clock.advance(0.004 if steps else 0.0)
        return fit(data, *rest, steps=steps, should_stop=stop, **more)

    monkeypatch.setattr(gpvr, "predictive_variance", slow_variance)
    monkeypatch.setattr(gpvr, "fit", slow_fit)
    return clock


@pytest.mark.parametrize("budget_s", [0.012, 0.02, 0.05, 0.1, 0.2])
@in_time
def test_the_process_is_fitted_in_time(scene: Scene, clock: SimulatedClock, budget_s: float) -> None:
    """All of it is 126 points, 32 ms for their variance and 16 ms a step."""
    policy = GPVRPolicy(PLANNER, GPVRSettings(max_points=200), now=clock)
    plan, made = None, []
    for _ in range(5):
        begun, random = clock(), torch.Generator().manual_seed(0)
        plan = policy.act(PlanRequest(believed(), scene, plan, executed=1, budget_s=budget_s, generator=random))
        assert clock() - begun <= budget_s
        assert plan.info["samples"] > 0
        made.append(plan.info["gp_points"])
    assert min(made) >= 50
    assert max(made) < 126 or budget_s == 0.2


@in_time
def test_without_time_for_a_fit_the_start_is_what_it_was(scene: Scene, clock: SimulatedClock) -> None:
    policy, random = GPVRPolicy(PLANNER, GPVRSettings(max_points=200), now=clock), torch.Generator().manual_seed(0)
    hurried = policy.act(PlanRequest(believed(), scene, budget_s=0.012, generator=random))
    assert hurried.info["gp_hyperparameters"] == list(gpvr.Hyperparameters())
    assert hurried.info["gp_points"] == 50
    ample = policy.act(PlanRequest(believed(), scene, budget_s=60.0, generator=random))
    assert ample.info["gp_points"] == 126
    assert ample.info["gp_hyperparameters"] != list(gpvr.Hyperparameters())


@in_time
def test_a_stall_of_a_fit_is_forgotten(scene: Scene, clock: SimulatedClock) -> None:
    """A step that once took long leaves no time for any; without any nothing would tell that they are quick again."""
    policy, random = GPVRPolicy(PLANNER, GPVRSettings(max_points=200), now=clock), torch.Generator().manual_seed(0)
    plan = policy.act(PlanRequest(believed(), scene, budget_s=0.1, generator=random))
    plan.info["pace"]["gp_step"] *= 30.0
    fitted = []
    for _ in range(14):
        before = plan.info["gp_hyperparameters"]
        plan = policy.act(PlanRequest(believed(), scene, plan, executed=1, budget_s=0.1, generator=random))
        fitted.append(plan.info["gp_hyperparameters"] != before)
    assert not any(fitted[:5])
    assert any(fitted)


@in_time
def test_what_a_fit_needs_is_loaded_before_the_first_plan() -> None:
    code = (
        "import sys; from rumi.planning.gpvr import GPVRPolicy; GPVRPolicy(); before = set(sys.modules)\n"
        "import torch; from rumi.planning import implicit_surface as surface\n"
        "surface.fit(surface.Labelled(torch.eye(3).double(), torch.tensor([0.0, 1.0, 1.0]).double()), steps=2)\n"
        "print(len(set(sys.modules) - before))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) == 0
