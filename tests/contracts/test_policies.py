"""Laws of every policy: RUMI, its ablations and the baselines; also of one from outside."""

import copy
import importlib.util
import json
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from kmppi import MPPI, MPPISettings
from kmppi.types import Objective
from rumi.belief.particles import PoseBelief
from rumi.dynamics.displacement_rollouts import DisplacementSettings
from rumi.dynamics.registry import EngineSettings
from rumi.fields.workspace import Workspace
from rumi.planning.gpvr import GPVRSettings
from rumi.planning.policy import Plan, PlanRequest, Policy, Scene, act_scenes
from rumi.planning.registry import POLICIES
from rumi.planning.rummaging import RummagingSettings
from rumi.robot.tool import Tool
from rumi.runs.plain import plain
from rumi.tasks.rummage.build import make_policy
from rumi.tasks.rummage.settings import Settings
from sdf import se3
from sdf.object_model import ObjectModel, object_model
from sdf.primitives import Mug
from sdf.symmetry import Symmetries
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics
from tests.fixtures.readings import make_reading

HEIGHT = 0.045
BOUNDS = torch.tensor([[0.0, -0.4, 0.03], [0.8, 0.4, 0.2]])
PLANNER = RummagingSettings(
    mppi=MPPISettings(horizon=5, knots=3, samples=40, warmup_iterations=2, temperature=0.1, cost_scale="std"),
    push=DisplacementSettings(mini_steps=2),
    rollouts=2,
)

pytestmark = pytest.mark.outcome
GPVR = GPVRSettings(refit_steps=5, max_points=40)
OUTSIDE, NEXT_TOUCH = "wandering", "next-touch"
SAMPLING = ("rumi", "info-only", "reach-only", "gpvr", "gpvr-greedy")  # these roll samples of their plans out
NEEDS = {"gpvr": "gpytorch", "gpvr-greedy": "gpytorch"}
CENTRE = torch.tensor([0.4, 0.0, 0.3])


@pytest.fixture(params=[*POLICIES, OUTSIDE, NEXT_TOUCH])
def method(request: pytest.FixtureRequest, outside: None) -> str:
    library = NEEDS.get(request.param)
    if library and importlib.util.find_spec(library) is None:
        pytest.skip(f"{request.param} needs {library}")
    return request.param


@pytest.fixture
def policy(method: str, scene: Scene) -> Policy:
    reach = (1.0 - scene.workspace.points[:, 0]).clamp(0, 1)
    if method == NEXT_TOUCH:
        if not scene.tool.spatial:
            pytest.skip("it chooses ways in space")
        return make_policy(Settings(method="rumi", planner=replace(PLANNER, next_touch=True)), reach)
    return make_policy(Settings(method=method, planner=PLANNER, gpvr=GPVR), reach)


@pytest.fixture(scope="module")
def mug() -> ObjectModel:
    return object_model("mug", Mug(), Symmetries.none(), spacing=0.004, points=120)


@pytest.fixture(params=["plane", "space"])
def scene(request: pytest.FixtureRequest, mug: ObjectModel) -> Scene:
    """A tool that moves in a plane, with three controls, and one that moves in space, with four."""
    if request.param == "plane":
        box = torch.tensor([[0.0, -0.4, HEIGHT], [0.8, 0.4, HEIGHT]])
        workspace = Workspace.from_bounds(box, 0.02, planar_height=HEIGHT)
        bounds = BOUNDS[:, :2]
    else:
        workspace, bounds = Workspace.from_bounds(torch.tensor([[0.0, -0.4, 0.0], [0.8, 0.4, 0.2]]), 0.04), BOUNDS
    tool = Tool(bounds, height_m=HEIGHT, body_spacing_m=0.02, info_spacing_m=0.01)
    bare = Scene(mug, workspace, tool, torch.zeros(0))
    return put(bare, (0.2, 0.0), 0.0, seen(mug))


def put(scene: Scene, place: tuple[float, float], yaw: float, observed: Observation, **felt: Any) -> Scene:
    """The tool somewhere at its height."""
    height = [0.06] if scene.tool.spatial else []
    return at(replace(scene, configuration=torch.tensor([*place, *height, yaw])), observed, **felt)


def seen(model: ObjectModel) -> Observation:
    """The near side of the mug, and free space before it."""
    surface = se3.apply(se3.from_planar(CENTRE), model.surface_points)
    near = surface[surface[:, 0] < CENTRE[0] - 0.01]
    free = near - torch.tensor([0.05, 0.0, 0.0])
    return concatenate([Observation.of(near, Semantics.SURFACE), Observation.of(free, Semantics.FREE)])


def at(scene: Scene, observed: Observation, *, contact: bool = False, touched: Tensor | None = None) -> Scene:
    """The scene with a reading taken where the tool is."""
    points = torch.zeros(0, 3) if touched is None else touched
    now = scene.configuration
    reading = make_reading(
        Observation.of(points, Semantics.SURFACE),
        tool=scene.tool.pose(now.expand(2, -1)),
        contact=torch.tensor([False, contact]),
        configuration=now,
    )
    return replace(scene, observed=observed, reading=reading)


def believed(count: int = 15, spread: float = 1.0) -> PoseBelief:
    random = torch.Generator().manual_seed(3)
    noise = torch.randn(count, 3, generator=random) * torch.tensor([0.005, 0.005, 0.8])
    return PoseBelief.uniform(se3.from_planar(CENTRE + spread * noise))


def act(policy: Policy, scene: Scene, belief: PoseBelief, previous: Plan | None = None, seed: int = 0) -> Plan:
    random = torch.Generator().manual_seed(seed)
    return policy.act(PlanRequest(belief, scene, previous, executed=1, generator=random))


def check(plan: Plan, scene: Scene) -> None:
    """A plan that can be carried out, recorded and drawn."""
    count, size = len(plan.controls), len(scene.configuration)
    assert count >= 1
    assert plan.controls.shape == (count, size)
    assert bool(plan.controls.isfinite().all())
    assert float(plan.controls.abs().max()) <= 1.0
    assert plan.path.shape == (count + 1, size)
    assert bool(plan.path.isfinite().all())
    assert torch.equal(plan.path[0], scene.configuration)
    place, bounds = plan.path[:, :-1], scene.tool.bounds
    assert bool(((place >= bounds[0] - 1e-5) & (place <= bounds[1] + 1e-5)).all())
    for values in plan.fields.values():
        assert values.shape == (len(scene.workspace),)
        assert bool(values.isfinite().all())
    assert all(0.0 <= share <= 1.0 for share in plan.skipped.values())
    assert json.loads(json.dumps(plain(plan.info))) == plan.info


def test_is_a_policy(policy: Policy) -> None:
    assert isinstance(policy, Policy)


def test_first_plan_without_contact(policy: Policy, scene: Scene) -> None:
    check(act(policy, scene, believed()), scene)


def test_same_seed_same_plan(policy: Policy, scene: Scene) -> None:
    """Also with a plan before, and with another run in between: a policy keeps nothing."""
    before = torch.get_rng_state()
    first = act(policy, scene, believed(), seed=4)
    later = act(policy, scene, believed(), first, seed=5)
    act(policy, scene, believed(spread=0.1), seed=6)
    again = act(policy, scene, believed(), seed=4)
    assert torch.equal(first.controls, again.controls)
    assert torch.equal(later.controls, act(policy, scene, believed(), again, seed=5).controls)
    assert torch.equal(torch.get_rng_state(), before)


def test_plans_go_on_through_a_contact(policy: Policy, scene: Scene) -> None:
    plan = act(policy, scene, believed())
    touched = torch.tensor([[0.36, 0.0, HEIGHT], [0.361, 0.002, HEIGHT]])
    close = put(scene, (0.32, 0.0), 0.2, scene.observed, contact=True, touched=touched)
    for _ in range(3):
        plan = act(policy, close, believed(), plan)
        check(plan, close)


@pytest.mark.parametrize("count", [1, 2])
def test_few_particles(policy: Policy, scene: Scene, count: int) -> None:
    check(act(policy, scene, believed(count)), scene)


def test_a_sure_belief(policy: Policy, scene: Scene) -> None:
    """Nothing is left to learn."""
    check(act(policy, scene, believed(spread=0.0)), scene)
    lone = believed().reweighted(torch.tensor([0.0] + [-1e6] * 14))
    check(act(policy, scene, lone), scene)


def test_nothing_observed_yet(policy: Policy, scene: Scene) -> None:
    """A first view may not show the object at all."""
    blind = at(scene, Observation.empty())
    check(act(policy, blind, believed(spread=5.0)), blind)


def test_contact_without_points(policy: Policy, scene: Scene) -> None:
    felt = at(scene, scene.observed, contact=True)
    check(act(policy, felt, believed()), felt)


@pytest.mark.parametrize("corner", [(0.0, -0.4), (0.8, 0.4)])
def test_at_the_border(policy: Policy, scene: Scene, corner: tuple[float, float]) -> None:
    there = put(scene, corner, 3.0, scene.observed)
    check(act(policy, there, believed()), there)


def test_on_top_of_the_object(policy: Policy, scene: Scene) -> None:
    """The tool is where the belief has the object's middle: no direction leads there."""
    middle = believed().world_T_object[:, :3, 3].mean(0)
    there = put(scene, (float(middle[0]), float(middle[1])), 0.0, scene.observed)
    check(act(policy, there, believed(spread=0.0)), there)


def test_a_spent_budget(policy: Policy, scene: Scene) -> None:
    random = torch.Generator().manual_seed(0)
    check(policy.act(PlanRequest(believed(), scene, budget_s=0.0, generator=random)), scene)


def test_later_plans_with_a_spent_budget(policy: Policy, scene: Scene) -> None:
    random = torch.Generator().manual_seed(0)
    plan = policy.act(PlanRequest(believed(), scene, budget_s=5.0, generator=random))
    for budget_s in (0.0, 1e-4, 0.02):
        plan = policy.act(PlanRequest(believed(), scene, plan, executed=1, budget_s=budget_s, generator=random))
        check(plan, scene)


def test_an_ample_budget_changes_nothing(policy: Policy, scene: Scene) -> None:
    """First and later plans are the same to the bit as without a budget; `info` says more."""
    free = ample = None
    for seed in range(3):
        one, other = (torch.Generator().manual_seed(seed) for _ in range(2))
        free = policy.act(PlanRequest(believed(), scene, free, executed=1, generator=one))
        ample = policy.act(PlanRequest(believed(), scene, ample, executed=1, budget_s=600.0, generator=other))
        assert torch.equal(free.controls, ample.controls)
        assert torch.equal(free.path, ample.path)
        assert {name: ample.info[name] for name in free.info} == free.info
        assert free.fields.keys() == ample.fields.keys()
        assert all(torch.equal(free.fields[name], ample.fields[name]) for name in free.fields)
        assert "pace" not in free.info


@pytest.mark.parametrize("push_model", ["displacement", "quasi-static", "mujoco"])
def test_samples_cost_alone_what_they_cost_together(
    method: str, push_model: str, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To the bit, whatever processor works out how many at once: else a budget, which takes them in parts, counted."""
    if method not in SAMPLING:
        pytest.skip("takes no samples")
    if push_model == "mujoco":
        if method != "rumi":
            pytest.skip("slow, and rolled out alike for each method")
        pytest.importorskip("mujoco")
    elif push_model == "quasi-static" and scene.tool.spatial:
        pytest.skip("pushes level tools only")
    few = replace(PLANNER.mppi, samples=12, warmup_iterations=1) if push_model == "mujoco" else PLANNER.mppi
    # which of them are rolled out in full hangs on the others, what that costs does not
    planner = replace(PLANNER, screen_kept=1.0)
    planner = replace(planner, push_model=push_model, mppi=few, engine=EngineSettings(time_step_s=0.01, action_s=0.2))
    policy = make_policy(
        Settings(method=method, planner=planner, gpvr=GPVR), (1.0 - scene.workspace.points[:, 0]).clamp(0, 1)
    )
    evaluate, random = MPPI._evaluate, torch.Generator().manual_seed(0)
    whole: list[Tensor] = []

    def in_parts(self: MPPI, objective: Objective, controls: Tensor) -> Tensor:
        before = random.get_state()
        whole.append(evaluate(self, objective, controls))
        for size in (size for size in (1, 2, 7, 16, 33) if size < len(controls)):
            random.set_state(before)
            parts = [evaluate(self, objective, part) for part in controls.split(size)]
            assert torch.equal(torch.cat(parts), whole[-1]), f"parts of {size}"
        return whole[-1]

    monkeypatch.setattr(MPPI, "_evaluate", in_parts)
    close = put(scene, (0.3, 0.0), 0.2, scene.observed)
    plan = policy.act(PlanRequest(believed(), close, generator=random))
    policy.act(PlanRequest(believed(spread=0.1), close, plan, executed=1, generator=random))
    assert len(whole) >= 2
    # some of them touch, so that they do not all cost the same
    assert all(len(costs.unique()) > 3 for costs in whole)


def test_a_scene_of_a_batch_is_planned_as_alone(policy: Policy, scene: Scene) -> None:
    """First plans and later ones, in contact and out of it: to the bit, whatever the others are."""
    touched = torch.tensor([[0.36, 0.0, HEIGHT], [0.361, 0.002, HEIGHT]])
    close = put(scene, (0.32, 0.0), 0.2, scene.observed, contact=True, touched=touched)
    first = act(policy, scene, believed(), seed=7)
    given = [(scene, believed(), None), (close, believed(20, 0.5), None), (close, believed(), first)]

    def requests() -> list[PlanRequest]:
        random = (torch.Generator().manual_seed(row) for row in range(3))
        return [PlanRequest(b, s, p, executed=1, generator=one) for (s, b, p), one in zip(given, random, strict=True)]

    together = act_scenes(policy, requests())
    for plan, alone in zip(together, reversed([policy.act(one) for one in reversed(requests())]), strict=True):
        assert torch.equal(plan.controls, alone.controls)
        assert torch.equal(plan.path, alone.path)
        assert plan.info == alone.info
    shared = torch.Generator()
    with pytest.raises(ValueError, match="a generator for each scene"):
        act_scenes(policy, [PlanRequest(believed(), scene, generator=shared)] * 2)


def test_double_precision(policy: Policy, scene: Scene, mug: ObjectModel) -> None:
    wide, belief = torch.float64, believed().to(dtype=torch.float64)
    reading = scene.reading
    there = Scene(
        mug.to(wide),
        scene.workspace.to(wide),
        copy.deepcopy(scene.tool).to(wide),
        scene.configuration.double(),
        scene.observed.to(dtype=wide),
        replace(
            reading,
            observation=reading.observation.to(dtype=wide),
            tool_pose=reading.tool_pose.double(),
            configuration=reading.configuration.double(),
        ),
    )
    plan = act(policy, there, belief)
    check(plan, there)
    assert plan.controls.dtype == wide


def test_says_what_it_predicts(method: str, policy: Policy, scene: Scene) -> None:
    """One number and one displacement an action, from every policy that rolls its plans out."""
    plan = act(policy, scene, believed())
    if method == NEXT_TOUCH:  # what a touch tells, and not where it takes the object
        assert len(plan.info["predicted_information"]) == len(plan.controls)
        assert "predicted_displacement" not in plan.info
        return
    if method not in SAMPLING:
        assert "predicted_information" not in plan.info
        return
    gathered, moved = (torch.tensor(plan.info[f"predicted_{name}"]) for name in ("information", "displacement"))
    assert gathered.shape == (len(plan.controls),)
    assert bool((gathered >= 0).all())
    assert moved.shape == (len(plan.controls), 3)
    torch.testing.assert_close(moved.sum(0), torch.tensor(plan.info["displacement"]), atol=1e-5, rtol=0)
