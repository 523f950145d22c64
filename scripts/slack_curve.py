"""Curve of the methods over one knob of the scene: how far a mug may still be pushed until the arm cannot touch it.

python -m scripts.slack_curve run --seeds 1000-1004    # tuning; the same command goes on
python -m scripts.slack_curve run                      # the record: seeds 0-19
python -m scripts.slack_curve show
python -m scripts.slack_curve figure --out slack.png

The knob turns two things at once that make a mug hard to find, evenly from easy to hard. Its slack: the mug stands 160,
120, 80, 40 or 0 mm nearer to the base than 1.05 m, from where on under a tenth of what is to be learnt can be touched
(`python -m scripts.hardness`). And where the handle is, which alone tells the yaw: within 100, 80, 60, 40 or 20 degrees
of straight behind the mug as the camera sees it. All else is drawn as of the task `mug`; nothing measures the motion.
Chosen before any method was run on these scenes. Left out: walls and a table's edge, which the tasks have not, and how
far a push carries, since pushes end where the tool does.

Two are no methods, since they are told where the object truly is. `told` plans as `rumi` does for the information that
the belief asks for, but pushes the object from there; `shortest` goes the shortest way to a touch that tells
(`scripts/shortest_touch.py`).
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import radians
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from rumi.cache import cache_folder
from rumi.cli import script
from rumi.dynamics.base import RolloutModel
from rumi.dynamics.push_posterior import PushPosterior
from rumi.dynamics.registry import PushModels, PushSettings
from rumi.fields.information import WorkspaceFields
from rumi.fields.workspace import Workspace
from rumi.planning.rummaging import RummagingPolicy
from rumi.records import StepRecord
from rumi.robot.tool import Tool
from rumi.tasks.registry import TASKS, TaskEntry
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.drawn_scenes import DRAWN
from rumi.tasks.rummage.entry import RummageTask
from rumi.tasks.rummage.scene_spec import TaskSpec
from rumi.tasks.rummage.settings import Settings, preset
from scripts.experiment import FIGURES, RESULTS, Experiment, Line
from scripts.outcomes import by_chance, ended, right, won_lost, wrong
from scripts.reproduce.cells import middle, rate, table
from scripts.reproduce.intervals import wilson
from scripts.shortest_touch import ShortestTouchPolicy
from scripts.store import Store
from sdf.object_model import ObjectModel

KNOB = {0: (160, 100), 25: (120, 80), 50: (80, 60), 75: (40, 40), 100: (0, 20)}
"""Slack in mm, and degrees from straight behind within which the handle is, by the knob's per cent."""

EDGE_M, STEPS = 1.05, 25
METHODS = ("rumi", "info-only", "reach-only", "slide", "gpvr", "told", "shortest")
TOLD = ("told", "shortest")
SLOW, SLOW_AT = "gpvr", (0, 50, 100)


def scene(knob: int) -> TaskSpec:
    """The mug of the family, by the knob's per cent."""
    spec, (slack, hidden) = DRAWN["mug"], KNOB[knob]
    assert spec.draw is not None
    metres = EDGE_M - 1e-3 * slack
    draw = replace(spec.draw, distance_m=(metres, metres), turn_rad=radians(hidden))
    return replace(spec, name=f"mug-slack-{slack}", description=f"a mug with {slack} mm of slack", draw=draw)


for _knob in KNOB:
    TASKS.add(scene(_knob).name, cast(TaskEntry[Any], RummageTask(scene(_knob))))


class ToldPushes(PushModels):
    """Push models that are told where the object truly is: rollouts of one pose.

    Args:
        settings: of the push models.
        truth: (4, 4) world_T_object at this instant.
    """

    def __init__(self, settings: PushSettings, truth: Callable[[], Tensor]) -> None:
        super().__init__(settings)
        self.truth = truth

    def rollouts(
        self,
        model: ObjectModel,
        world_T_object: Tensor,
        log_weights: Tensor,
        tool: Tool,
        workspace: Workspace,
        fields: WorkspaceFields,
        *,
        pushes: PushPosterior | None = None,
    ) -> RolloutModel:
        """Rollouts from the truth, whatever the belief."""
        pose, weight = self.truth().to(world_T_object)[None], log_weights.new_zeros(1)
        return super().rollouts(model, pose, weight, tool, workspace, fields, pushes=pushes)


def settings_of(method: str, knob: int, seed: int) -> Settings:
    """Settings of a run in which nothing measures the object's motion."""
    own = preset(task=scene(knob).name, seed=seed, steps=STEPS, conditions="ideal", **{"filter.motion": "trajectory"})
    return by_chance(replace(own, method="rumi" if method in TOLD else method))


def measure(method: str, knob: int, seed: int) -> dict[str, Any]:
    """How a run ended."""
    steps: list[StepRecord] = []
    begun = time.process_time()
    with build(settings_of(method, knob, seed), cache_dir=cache_folder()) as parts:
        if method == "told":
            policy = parts.agent.policy
            assert isinstance(policy, RummagingPolicy)
            policy.push_models = ToldPushes(policy.settings, lambda: _truth(steps))
        if method == "shortest":
            agent = replace(parts.agent, policy=ShortestTouchPolicy(lambda: _truth(steps)))
            parts = replace(parts, agent=agent)
        found = ended(parts, seed, steps.append)
        base = torch.tensor(scene(knob).base[:2], dtype=torch.float64)
    away_mm = 1e3 * float((_truth(steps)[:2, 3] - base).norm())
    more = {"steps": steps[-1].step, "contacts": steps[-1].contacts, "away_mm": away_mm}
    return found | more | {"cpu_s": time.process_time() - begun}


def _truth(steps: Sequence[StepRecord]) -> Tensor:
    truth = steps[-1].truth
    assert truth is not None
    return truth.to("cpu", torch.float64)


def show(lines: list[Line], chosen: object) -> str:
    """A row for each value of the knob and method, paired by seed with rumi."""
    rows = []
    for knob, (slack, hidden) in KNOB.items():
        by = {m: {x["seed"]: x for x in lines if x["knob"] == knob and x["method"] == m} for m in METHODS}
        rows += [[f"{slack} mm, {hidden} deg", m, *_row(by[m], by["rumi"])] for m in METHODS if by[m]]
    heads = ("slack, handle within", "method", "right", "sure and wrong", "actions of the right ones")
    return table((*heads, "won; lost against rumi (p)", "fewer actions than rumi, both right"), rows)


def _row(runs: dict[int, Line], own: dict[int, Line]) -> list[str]:
    both = sorted(runs.keys() & own.keys())
    fewer = [float(own[s]["steps"] - runs[s]["steps"]) for s in both if right(runs[s]) and right(own[s])]
    paired = runs is not own
    return [
        rate([right(x) for x in runs.values()]),
        rate([wrong(x) for x in runs.values()]),
        middle([float(x["steps"]) for x in runs.values() if right(x)]),
        won_lost(runs, own) if paired else "",
        middle(fewer) if paired else "",
    ]


@dataclass(frozen=True)
class Figure:
    """Draw the curve: share of runs that end right, and their actions, over the knob."""

    out: Path = FIGURES / "slack.png"
    results: Path = RESULTS / "slack_curve.jsonl"


def figure(options: Figure) -> None:
    """Draw both curves, a line a method; bars are Wilson's 95 % intervals."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    lines = Store(options.results).flat()
    made, (share, actions) = pyplot.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for k, method in enumerate(METHODS):
        at, rates, bars, middles = [], [], [], []
        for knob, (slack, _) in KNOB.items():
            runs = [x for x in lines if x["method"] == method and x["knob"] == knob]
            if not runs:
                continue
            found = [x["steps"] for x in runs if right(x)]
            low, high = wilson(len(found), len(runs))
            p = len(found) / len(runs)
            at.append(slack + 2.0 * (k - 2.5))
            rates.append(p)
            bars.append((p - low, high - p))
            middles.append(float(torch.tensor(found, dtype=torch.float64).quantile(0.5)) if found else float("nan"))
        if at:
            share.errorbar(at, rates, torch.tensor(bars).clamp_min(0).T.numpy(), fmt="o-", capsize=3, label=method)
            actions.plot(at, middles, "o-", label=method)
    for axes, said in ((share, "runs that end sure and right"), (actions, "actions of those, median")):
        axes.invert_xaxis()
        axes.set(xlabel="slack to the edge of reach [mm]", ylabel=said)
        axes.grid(alpha=0.3)
    made.legend(*share.get_legend_handles_labels(), loc="outside upper center", ncols=len(METHODS))
    made.savefig(options.out, dpi=120)
    pyplot.close(made)


EXPERIMENT = Experiment(
    __doc__,
    "slack_curve.jsonl",
    {"method": METHODS, "knob": tuple(KNOB)},
    measure,
    show,
    seeds="0-19",
    possible=lambda variant: variant["method"] != SLOW or variant["knob"] in SLOW_AT,
    commands={"figure": (Figure, figure)},
)

if __name__ == "__main__":
    script(EXPERIMENT.main)
