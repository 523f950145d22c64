"""One whole planning pass: fields, push model, costs, sampling."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.bench.case import Case, Setup, case, cases
from rumi.bench.cases.rollouts import bench_tool
from rumi.bench.scenes import FieldScene, box_scene, mug_scene
from rumi.planning.policy import Plan, PlanRequest, Policy, Scene
from rumi.planning.rummaging import RummagingPolicy, RummagingSettings
from rumi.seeding import split
from rumi.tasks.rummage.build import build, reachability
from rumi.tasks.rummage.first_belief import first_belief
from rumi.tasks.rummage.settings import preset

_SEED = 0


def _pass(
    policy: Policy, belief: PoseBelief, scene: Scene, previous: Plan, executed: int
) -> Callable[[], tuple[Tensor, Plan]]:
    def run() -> tuple[Tensor, Plan]:
        random = split(_SEED, "bench/plan")
        plan = policy.act(PlanRequest(belief, scene, previous, executed=executed, generator=random))
        return plan.controls, plan

    return run


def _case(title: str, setup: Setup, policy: Policy, belief: PoseBelief, scene: Scene, *, plain: bool = True) -> Case:
    first = policy.act(PlanRequest(belief, scene, generator=split(_SEED, "bench/first")))
    run = _pass(policy, belief, scene, first, 3)
    plan = run()[1]
    passes = [plan.timings_s] + [run()[1].timings_s for _ in range(0 if setup.tiny else 3)]
    least = {stage: min(seconds[stage] for seconds in passes) for stage in plan.timings_s}
    skipped = {f"skipped, {name.replace('_', ' ')}": round(share, 3) for name, share in plan.skipped.items() if share}
    spent = {f"{name.replace('_', ' ')}, ms": round(1e3 * s, 2) for name, s in least.items()}
    ways = setup.ours(run)
    return Case(
        title,
        ways if plain else ways[-1:],
        otherwise=ways[0 if plain else -1].name,
        # controls may differ by all there is: which of two as good is best hangs on the last digits of their costs
        error=lambda found, reference: abs(_least(found[1]) - _least(reference[1])),
        tolerance=0.05,
        facts={"error": "of the least cost of a sample"} | skipped | spent,
    )


def _least(plan: Plan) -> float:
    """Cost of the best sample of a pass's last iteration."""
    return float(plan.info["least_cost"])


@cases(
    {
        "plan-mug": ("mug-0", "displacement"),
        "plan-mug-pushed": ("mug-0", "quasi-static"),
        "plan-drill-space": ("drill-0", "displacement"),
        "plan-box-space": ("box-0", "displacement"),
    }
)
@cases(
    {"plan-mug-16000": ("mug-0", "quasi-static", 16_000), "plan-drill-16000": ("drill-0", "displacement", 16_000)},
    slow=True,
)
def plan(setup: Setup, task: str, push_model: str, samples: int | None = None) -> Case:
    """The planning pass of a task under a push model: of mug-0 after its first view, else before anything is seen.

    By many samples the compiled version alone, which the plain one would take minutes to follow.
    """
    if setup.tiny:
        made_up = mug_scene(setup) if task == "mug-0" else box_scene(setup)
        return _made_up(setup, made_up, "made up", push_model)
    settings = preset("default", task=task, seed=_SEED, device=setup.device.type, **{"filter.motion": "measured"})
    planner = settings.planner
    if samples is not None:
        planner = replace(planner, mppi=replace(planner.mppi, samples=samples))
    settings = replace(settings, planner=replace(planner, push_model=push_model))
    parts = build(settings, cache_dir=setup.cache_dir)
    try:
        reading = parts.task.reset(_SEED).reading
    finally:
        parts.task.close()
    rummager = parts.agent
    belief, _ = first_belief(rummager, reading, generator=split(_SEED, "initialise"))
    scene = Scene(rummager.model, rummager.workspace, rummager.tool, reading.configuration)
    return _case(
        f"planning pass of {task}, {push_model}: {_effort(settings.planner, push_model)}",
        setup,
        rummager.policy,
        belief,
        scene,
        plain=samples is None,
    )


@case("plan-box")
def plan_box(setup: Setup) -> Case:
    """A planning pass over 3-D fields."""
    return _made_up(setup, box_scene(setup), "3-D fields; the tool and the object move in the plane only")


def _effort(settings: RummagingSettings, push_model: str) -> str:
    rollouts = settings.suited(push_model).rollouts
    return f"{settings.mppi.iterations} iterations of {settings.mppi.samples} x {rollouts} rollouts"


def _made_up(
    setup: Setup,
    scene: FieldScene,
    what: str,
    push_model: str = "displacement",
) -> Case:
    settings, tool = replace(preset("default").planner, push_model=push_model), bench_tool(setup)
    if setup.tiny:
        few = replace(settings.mppi, samples=10, warmup_iterations=1, horizon=5, knots=3)
        settings = replace(settings, mppi=few, rollouts=2)
    belief = PoseBelief.uniform(scene.world_T_object).reweighted(scene.log_weights)
    start = torch.tensor([0.28, 0.02, 0.1], device=setup.device)
    policy = RummagingPolicy(reachability(tool, scene.workspace), settings)
    title = f"planning pass, {what}: {scene.what}; {_effort(settings, push_model)}"
    return _case(title, setup, policy, belief, Scene(scene.model, scene.workspace, tool, start))
