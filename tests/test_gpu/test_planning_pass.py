"""A planning pass on a GPU, pretended and real: what it asks of one, and that its plan is the CPU's."""

import copy
import math
from collections import Counter
from dataclasses import replace

import pytest
import torch

from rumi.belief.particles import PoseBelief
from rumi.fields.information import information_field
from rumi.planning.policy import Plan, PlanRequest, Scene
from rumi.planning.rummaging import RummagingPolicy
from rumi.seeding import split
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.settings import preset
from sdf import backend, gpu, se3
from tests.fixtures.pretended_gpu import pretended_gpu, to_cpu

pytest.importorskip("warp")

LAUNCHES = 300
"""What a pass may ask for, all told: its beginning and what is fetched at its end too."""
PASSES = [("mug-0", "quasi-static"), ("mug-0", "displacement"), ("drill-0", "displacement")]


@pytest.fixture
def reach(task, request):
    """Folder of reach tables: of an arm that reaches everywhere, in a folder of its own, for what moves in space."""
    return request.getfixturevalue("cache" if task == "mug-0" else "all_in_reach")


def scene_of(task, push_model, cache):
    """A task's policy, a belief of some poses about its workspace's middle, and the scene before the first action.

    Few samples: how many launches a pass is does not hang on their number.
    """
    settings = preset("default", task=task, seed=1000, **{"filter.motion": "measured"})  # whose plans are by rollouts
    parts = build(settings, cache_dir=cache)
    parts.task.close()
    own, planner = parts.agent, settings.planner
    few = replace(planner.mppi, samples=200, warmup_iterations=1)
    policy = RummagingPolicy(own.policy.reachability, replace(planner, mppi=few, push_model=push_model))
    middle = own.workspace.points.mean(0)
    spread = torch.randn(12, 3, generator=split(7, "poses")) * torch.tensor([0.01, 0.01, 0.6])
    planar = spread + torch.cat((middle[:2], torch.zeros(1)))
    belief = PoseBelief.uniform(se3.from_planar(planar, 0.0 if own.height_m is None else own.height_m))
    beside = middle + torch.tensor([-0.12, 0.02, 0.0])
    configuration = torch.cat((beside[: own.tool.scale.numel() - 1], torch.tensor([0.1])))
    return policy, belief, Scene(own.model, own.workspace, own.tool, configuration)


def moved(device, policy, belief, scene):
    """The same on another device."""
    reachability = None if policy.reachability is None else policy.reachability.to(device)
    held = Scene(
        scene.model.to(device),
        scene.workspace.to(device),
        copy.deepcopy(scene.tool).to(device),
        scene.configuration.to(device),
    )
    return RummagingPolicy(reachability, policy.settings), belief.to(device), held


def plans(policy, belief, scene, *, device="cpu", count=3) -> list[Plan]:
    """Plans one after the other, each from the one before."""
    made = [policy.act(PlanRequest(belief, scene, generator=split(1, "0", device)))]
    for number in range(1, count):
        random = split(1, str(number), device)
        made.append(policy.act(PlanRequest(belief, scene, made[-1], executed=2, generator=random)))
    return made


@pytest.mark.sim
@pytest.mark.parametrize(("task", "push_model"), PASSES)
def test_a_pass_is_few_launches_and_no_wait(task, push_model, reach):
    policy, belief, scene = scene_of(task, push_model, reach)
    with pretended_gpu() as counts:
        held = moved("cuda", policy, belief, scene)
        before = plans(*held, device="cuda", count=2)  # what is made once for an object is made
        counts.clear()
        request = PlanRequest(*held[1:], before[-1], executed=2, generator=split(1, "2", "cuda"))
        plan = held[0].act(request)
    assert sum(counts.launches.values()) <= LAUNCHES, counts.by_line().most_common(20)
    outside = {where.rpartition(", ")[2].rpartition(":")[0] for where in counts.waits}
    allowed = {"rumi/planning/rummaging.py"} | ({"rumi/dynamics/base.py"} if push_model == "quasi-static" else set())
    assert outside <= allowed and sum(counts.waits.values()) == len(allowed), counts.waits
    assert not counts.mixed and not counts.copies_in, counts.copies_in
    assert math.isfinite(plan.info["least_cost"]) and to_cpu(plan.controls).isfinite().all()
    assert set(plan.skipped) >= {"workspace_points", "information_cost"}


@pytest.mark.sim
def test_the_plan_is_that_of_the_same_kernels_on_the_cpu(cache):
    policy, belief, scene = scene_of("mug-0", "quasi-static", cache)
    with backend.force(gpu.VERSION):
        expected = plans(policy, belief, scene, count=2)
    with pretended_gpu():
        found = plans(*moved("cuda", policy, belief, scene), device="cuda", count=2)
    for own, there in zip(expected, found, strict=True):
        torch.testing.assert_close(to_cpu(there.controls), own.controls, atol=1e-4, rtol=0.0)
        assert there.info["information_total"] == pytest.approx(own.info["information_total"], rel=1e-5)


@pytest.mark.sim
def test_what_is_not_finite_is_told_at_the_end(cache):
    policy, belief, scene = scene_of("mug-0", "quasi-static", cache)
    broken = replace(belief, log_weights=torch.full_like(belief.log_weights, math.nan))
    with pretended_gpu(), pytest.raises(ValueError, match="finite"):
        plans(*moved("cuda", policy, broken, scene), device="cuda", count=1)


@pytest.mark.gpu
@pytest.mark.sim
@pytest.mark.parametrize(("task", "push_model"), PASSES)
def test_a_pass_on_a_gpu(task, push_model, reach):
    """Kernels by the profiler; a wait within the pass is an error; costs near those of the CPU for the same samples."""
    from torch.profiler import ProfilerActivity, profile

    policy, belief, scene = scene_of(task, push_model, reach)
    held = moved("cuda", policy, belief, scene)
    before = plans(*held, device="cuda", count=2)
    torch.cuda.synchronize()
    request = PlanRequest(*held[1:], before[-1], executed=2, generator=split(1, "2", "cuda"))
    with profile(activities=[ProfilerActivity.CUDA]) as profiled:
        plan = held[0].act(request)
        torch.cuda.synchronize()
    # what runs there, without what the host did to ask for it
    there = [event.name for event in profiled.events() if event.device_type == torch.autograd.DeviceType.CUDA]
    kernels = [name for name in there if not name.startswith(("Memcpy", "Memset"))]
    assert 0 < len(kernels) <= LAUNCHES, Counter(kernels).most_common(20)
    assert plan.controls.isfinite().all()


@pytest.mark.gpu
@pytest.mark.sim
def test_a_gpu_values_samples_as_the_cpu_does(cache):
    policy, belief, scene = scene_of("mug-0", "quasi-static", cache)
    controls = (2.0 * torch.rand(40, 15, 3, generator=split(3, "controls")) - 1.0) * 0.7
    costs = []
    for device in ("cpu", "cuda"):
        own, particles, held = moved(device, policy, belief, scene)
        poses, log_weights = particles.world_T_object, particles.log_weights
        fields = information_field(held.model.sdf, poses, log_weights, held.workspace.points)
        known = (held.model, poses, log_weights, held.tool, held.workspace, fields)
        model = own.push_models.rollouts(*known)
        objective = own.objective(particles, held, fields, None)
        random = split(4, "rollouts", device)
        rolled = model.rollout(held.configuration, controls.to(device), rollouts=8, generator=random)
        costs.append(objective.cost(rolled).cpu())
    torch.testing.assert_close(costs[1], costs[0], atol=2e-3, rtol=1e-3)
