"""What plans lose that roll few samples out in full, on the beliefs of runs.

python -m scripts.screening run --tasks mug-0 drill-0 --seeds 1000-1001     # again to go on
python -m scripts.screening show

A run with default settings gives its beliefs; on each but the first a plan is made by every variant, two noise draws
each, and its cost is taken under 64 full rollouts (40 in space). The loss is that cost less that of the plan without
screening, the gain that of standing still less that of the plan without screening.
"""

import statistics
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch

from rumi import loop
from rumi.cache import cache_folder
from rumi.cli import script
from rumi.clock import Stopwatch
from rumi.planning.plan_budget import PlanBudget
from rumi.planning.policy import PlanRequest
from rumi.seeding import generator
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.settings import preset
from scripts.experiment import Experiment, Line
from scripts.reproduce.cells import table

TASKS = ("mug-0", "mug-1", "mug-2", "drill-0", "drill-1", "drill-2", "box-0", "box-1", "box-2")
VARIANTS = {
    "2, an eighth": (2, 1 / 8),
    "2, a sixteenth": (2, 1 / 16),
    "2, a 31st": (2, 1 / 31),
    "1, an eighth": (1, 1 / 8),
}
DRAWS, STEPS = 2, 14


def measure(task: str, seed: int) -> dict[str, Any]:
    """Losses by variant, gains, and the CPU time of plans."""
    asked: list[PlanRequest] = []
    run = preset(task=task, seed=seed, steps=STEPS, **{"filter.motion": "measured"})  # plans by rollouts in space, too
    with build(run, cache_dir=cache_folder()) as (world, agent):
        policy: Any = agent.policy
        act = policy.act

        def kept(request: PlanRequest) -> Any:  # noqa: ANN401  (a plan)
            asked.append(replace(request))
            return act(request)

        policy.act = kept
        loop.run_to_end(world, agent, seed=seed)
        policy.act, own = act, policy.settings
        settings = {"full": replace(own, screen_kept=1.0)}
        settings |= {
            name: replace(own, screen_rollouts=rollouts, screen_kept=share)
            for name, (rollouts, share) in VARIANTS.items()
        }
        losses: dict[str, list[float]] = {name: [] for name in VARIANTS}
        seconds: dict[str, list[float]] = {name: [] for name in settings}
        gains: list[float] = []
        for request in asked[1:]:
            for draw in range(DRAWS):
                plans = []
                for name, chosen in settings.items():
                    policy.settings = chosen
                    begun = time.process_time()
                    plans.append(act(replace(request, generator=generator(draw))).controls)
                    seconds[name].append(time.process_time() - begun)
                policy.settings = own
                full, *others, still = _costs(policy, request, torch.stack([*plans, torch.zeros_like(plans[0])]))
                gains.append(still - full)
                for name, cost in zip(VARIANTS, others, strict=True):
                    losses[name].append(cost - full)
    return {
        "losses": losses,
        "gains": gains,
        "seconds": {name: statistics.median(own) for name, own in seconds.items()},
    }


def _costs(policy: Any, request: PlanRequest, controls: torch.Tensor) -> list[float]:  # noqa: ANN401
    """Costs of control sequences, by many full rollouts with the same draws."""
    budget = PlanBudget(None, time.perf_counter, None)
    view = policy._view_in_time(request.belief, request.scene, None, budget, Stopwatch(time.perf_counter))
    count = 40 if request.scene.tool.spatial else 64
    with torch.no_grad():
        rolled = view.model.rollout(request.scene.configuration, controls, rollouts=count, generator=generator(0))
        costs: list[float] = view.objective.cost(rolled).tolist()
    return costs


def show(lines: list[Line], chosen: Mapping[str, tuple[Any, ...]]) -> str:
    """A row for each kind of object."""
    rows = []
    for kind in ("mug", "drill", "box"):
        own = [line for line in lines if line["task"].startswith(kind)]
        if not own:
            continue
        gains = [gain for line in own for gain in line["gains"]]
        row = [kind, str(len(gains)), f"{statistics.fmean(gains):.3f}"]
        for name in VARIANTS:
            row.append(_mean([loss for line in own for loss in line["losses"][name]]))
        row += [f"{1e3 * statistics.fmean(line['seconds'][name] for line in own):.0f}" for name in ("full", *VARIANTS)]
        rows.append(row)
    heads = ["object", "beliefs x draws", "gain of a plan", *(f"loss, {name}" for name in VARIANTS)]
    return table([*heads, "ms in full", *(f"ms, {name}" for name in VARIANTS)], rows)


def _mean(values: list[float]) -> str:
    error = statistics.stdev(values) / len(values) ** 0.5 if len(values) > 1 else float("nan")
    return f"{statistics.fmean(values):.3f} +- {error:.3f}"


EXPERIMENT = Experiment(__doc__, "screening.jsonl", {"task": TASKS}, measure, show, seeds="1000-1001")

if __name__ == "__main__":
    script(EXPERIMENT.main)
