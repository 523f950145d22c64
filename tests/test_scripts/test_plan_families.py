"""Families of motions as nominal plans of mugs, the lattices that plans are judged on, and their tables."""

import math
from typing import Any

import pytest
import torch

pytest.importorskip("mujoco")

from kmppi import MPPI
from rumi.agent import Parts
from rumi.belief.particles import PoseBelief
from rumi.fields.information import information_field
from rumi.planning.policy import PlanRequest, Scene
from rumi.planning.rummaging import RummagingSettings
from rumi.task import Task
from rumi.tasks.rummage.agent import Rummager
from scripts import plan_families, plan_lattices, plan_regrets
from scripts.plan_families import FAMILIES, Around, Families, controls_of, families_of, with_variant
from scripts.plan_judging import parts
from scripts.plan_lattices import Given, judged
from scripts.plan_proposals import policy_of
from sdf import se3


@pytest.fixture(scope="module")
def own() -> Parts[Task, Rummager]:
    return Parts(*parts(8, 1, 1))


@pytest.fixture(scope="module")
def agent(own: Parts[Task, Rummager]) -> Rummager:
    return own.agent


@pytest.fixture(scope="module")
def request_of(agent: Rummager) -> PlanRequest:
    """A mug ahead of the tool, of unknown yaw."""
    random = torch.Generator().manual_seed(0)
    planar = torch.tensor([0.6, 0.0, 0.0]) + torch.tensor([0.005, 0.005, 0.8]) * torch.randn(20, 3, generator=random)
    belief = PoseBelief.uniform(se3.from_planar(planar, agent.height_m))
    return PlanRequest(belief, Scene(agent.model, agent.workspace, agent.tool, torch.tensor([0.45, 0.02, 0.0])))


@pytest.mark.usefixtures("at_home")
def test_controls_lead_along_waypoints_and_then_rest(agent: Rummager) -> None:
    start = torch.tensor([0.4, 0.0, 3.0])
    way = torch.tensor([[0.5, 0.0, 3.0], [0.5, 0.06, -3.0]])
    controls = controls_of(agent.tool, start, way, 15)
    reached = start + (controls * agent.tool.scale).cumsum(0)
    assert bool((controls.abs() <= 1.0).all()) and not bool(controls[3:].any())
    torch.testing.assert_close(reached[1, :2], way[0, :2])
    torch.testing.assert_close(reached[-1], torch.tensor([0.5, 0.06, 2.0 * math.pi - 3.0]))
    assert len(controls_of(agent.tool, start, way, 2)) == 2, "no longer than the horizon"


@pytest.mark.usefixtures("at_home")
def test_around_has_the_likeliest_pose_and_stances_face_it(agent: Rummager, request_of: PlanRequest) -> None:
    families = families_of("all three", agent)
    assert families is not None
    around = Around.of(request_of, families.outline)
    pose = se3.to_planar(request_of.belief.world_T_object)[0]
    handle = round(float(pose[2]) / (2.0 * math.pi) * len(around.radii)) % len(around.radii)
    assert int(around.radii.argmax()) in {(handle + k) % len(around.radii) for k in (-1, 0, 1)}, "the handle is along x"
    stance = around.stance(math.pi, 0.02)
    gap = around.middle - stance[:2]
    away = float(gap.norm()) - around.ahead_m - float(around.radii[len(around.radii) // 2])
    assert away == pytest.approx(0.02, abs=1e-6)
    assert float(gap @ torch.tensor([stance[2].cos(), stance[2].sin()])) == pytest.approx(float(gap.norm()), abs=1e-6)


@pytest.mark.usefixtures("at_home")
@pytest.mark.parametrize("name", FAMILIES)
def test_each_family_gives_knots_of_plans_that_touch(agent: Rummager, request_of: PlanRequest, name: str) -> None:
    own = policy_of(agent)
    poses, log_weights = request_of.belief.world_T_object, request_of.belief.log_weights
    fields = information_field(agent.model.sdf, poses, log_weights, agent.workspace.points, own.settings.information)
    families = families_of(name, agent)
    assert isinstance(families, Families)
    knots = families(request_of, fields)
    controls = MPPI(own.settings.mppi, 3).from_knots(knots).controls
    model = own.push_models.rollouts(agent.model, poses, log_weights, agent.tool, agent.workspace, fields)
    found = model.rollout(request_of.scene.configuration, controls, rollouts=4, generator=torch.Generator())
    assert knots.shape[1:] == (8, 3) and bool(knots.isfinite().all())
    # what is behind the mug is beyond the arm's reach, and so are ends of ways round it
    assert float(found.touched.float().mean()) > 0.2


@pytest.mark.usefixtures("at_home")
def test_variants_that_are_no_families(own: Parts[Task, Rummager], agent: Rummager) -> None:
    assert families_of("as it is", agent) is None
    assert plan_families.settings_of("mug", "sensed left out", 0).planner.sensed_here
    assert with_variant(own, "as it is") is own
    assert isinstance(policy_of(with_variant(own, "all three").agent).proposals, Families)


@pytest.mark.usefixtures("at_home")
def test_what_is_judged_is_the_planners_cost(agent: Rummager, request_of: PlanRequest) -> None:
    own, scene = policy_of(agent), request_of.scene
    here = Given("mug", agent.model, agent.tool, request_of.belief, scene.configuration)
    controls = torch.zeros(2, 15, 3)
    controls[1, :4, 0] = 0.5
    found = judged(here, "quasi-static", "10 mm", controls)
    poses, log_weights = request_of.belief.world_T_object, request_of.belief.log_weights
    fields = information_field(agent.model.sdf, poses, log_weights, agent.workspace.points, own.settings.information)
    model = own.push_models.rollouts(agent.model, poses, log_weights, agent.tool, agent.workspace, fields)
    rolled = model.rollout(scene.configuration, controls, rollouts=8, generator=torch.Generator())
    cost = own.objective(request_of.belief, scene, fields, None).cost(rolled)
    torch.testing.assert_close(-(found.information + found.reach), cost, atol=1e-4, rtol=1e-4)
    assert found.moves.tolist() == [0.0, 1.0] and bool((found.left <= found.information + 1e-6).all())


def test_lattices_and_models_are_those_of_the_table() -> None:
    figures = {
        "gain": 0.5,
        "information": 0.2,
        "still": 0.1,
        "still_left": 0.0,
        "left": 0.2,
        "moves": 0.3,
        "alike": 0.4,
    }
    line = {"belief": plan_lattices.BELIEFS[0], "push_model": "displacement", "times": 16, "seed": 1000}
    text = plan_lattices.show([line | dict.fromkeys(plan_lattices.LATTICES, figures)], {})
    assert "| displacement | mug-1, recorded | 1 | 0.50; 0.50; 0.50; 0.50 |" in text
    assert RummagingSettings().mppi.samples * max(plan_lattices.TIMES) == 8000


def test_tables_are_paired() -> None:
    run = {"task": "mug", "stopped_by": "sure", "lost": False, "right": True, "cpu_s": 2.0, "contacts": 3}
    lines = [run | {"variant": "as it is", "seed": seed, "steps": 9} for seed in (1, 2)]
    lines += [run | {"variant": "straight", "seed": seed, "steps": 9 + seed} for seed in (1, 2, 3)]
    own, other = plan_families.show(lines, {}).splitlines()[2:]
    assert own.split(" | ")[4] == "9.00" and other.split(" | ")[5].startswith("+1.50")
    worth = dict.fromkeys(("still", *plan_regrets.NAMES, *plan_regrets.LARGE), 0.75)
    worth |= {"still": 0.0, "as it is": 0.5, "all three": 1.0}
    line: dict[str, Any] = {"seed": 1, "worth": worth, "seconds": dict.fromkeys(worth, 0.1)}
    assert plan_regrets.regrets([line], "as it is") == [0.5] and plan_regrets.regrets([line], "all three") == [0.0]
    row = "| straight | 2 | 0.25 +- 0.00 | 0.25 | 0.25 | -0.25 [-0.25, -0.25] | 2 | 100 |"
    assert row in plan_regrets.show([line, line], {})
