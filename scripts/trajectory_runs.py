"""Closed loops on drawn scenes by how the object's motion is known: right, sure and wrong, cover of regions, time.

python -m scripts.trajectory_runs --seeds 1000-1019                    # runs what is missing, then prints the tables
python -m scripts.trajectory_runs --motions trajectory --seeds 1000-1009 --set filter.trajectories.across=0.45

A trajectory run goes on until every rule that is compared would have stopped it. Cover is of updates after the first
contact (`rumi.metrics.calibration`).
"""

import hashlib
import math
import re
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.cli import script
from rumi.information.stopping import STOP_RULES
from rumi.loop import run_to_end
from rumi.metrics.calibration import calibration_error, chance_error, checked
from rumi.metrics.pose_error import pose_error
from rumi.records import StepRecord
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.scenes import find_task
from rumi.tasks.rummage.settings import Settings, from_dict, preset, to_dict
from scripts.outcomes import unmeasured
from scripts.store import Store

RESULTS = Path(__file__).parent / "results" / "trajectories.jsonl"
# without what counts for a wrist force sensor, in space or for an inexact robot alone, so that other runs stay
_OTHERS = (
    "force_n|force_per_m|lean|soft|grip|missed|dead|tool_off_m|tool_off_rad|worn|size_off|view_off_m|view_off_rad|view_about_m|least_m|"
    "first_particles|replicates"
)
_NOT_HERE = re.compile(rf", ({_OTHERS})=(\([^)]*\)|[^,)]*)")
DEFAULTS = hashlib.sha256(_NOT_HERE.sub("", repr(PoseTrajectorySettings().for_mugs())).encode()).hexdigest()[:8]
Motion = Literal["trajectory", "corrected", "estimated", "pushed", "measured"]


@dataclass(frozen=True)
class Options:
    """What is run.

    Attributes:
        task: that draws its scenes.
        seeds: first and last.
        motions: how the filter knows the motion.
        set: other settings, as name=number.
        conditions: of the scenes, by name.
        steps: actions at most.
        results: file of the figures.
        only_print: run nothing.
    """

    task: str = "mug"
    seeds: str = "1000-1009"
    motions: tuple[Motion, ...] = ("trajectory", "corrected", "measured")
    set: tuple[str, ...] = ()
    conditions: str = "ideal"
    steps: int = 25
    results: Path = RESULTS
    only_print: bool = False


def settings_of(options: Options, motion: str, seed: int) -> Settings:
    """Of one run."""
    most = min(options.steps, find_task(options.task).steps)  # as on the shelf, where 15 are allowed
    settings = preset("default", task=options.task, seed=seed, steps=most, conditions=options.conditions)
    values = to_dict(settings)
    for assignment in options.set:
        name, _, number = assignment.partition("=")
        at: Any = values
        *folders, last = name.split(".")
        for folder in folders:
            at = at[folder]
        at[last] = type(at[last])(float(number))
    settings = from_dict(values)
    settings = replace(settings, filter=replace(settings.filter, motion=motion))
    if motion == "trajectory":
        settings = replace(settings, stop=replace(settings.stop, rule="compared"))
    return settings if motion == "measured" else unmeasured(settings)


def measured(options: Options, motion: str, seed: int) -> dict[str, Any]:
    """The figures of a run, one entry a step."""
    steps: list[dict[str, Any]] = []
    updates: list[float] = []
    began = [0.0]
    with build(settings_of(options, motion, seed), cache_dir=Path("runs/cache")) as (task, agent):
        agent.filter.register_forward_pre_hook(lambda *_: began.__setitem__(0, time.process_time()))
        agent.filter.register_forward_hook(lambda *_: updates.append(time.process_time() - began[0]))

        def note(step: StepRecord) -> None:
            belief, truth = step.belief, step.truth
            assert truth is not None
            metres, radians = pose_error(belief.mode(), truth, agent.model.symmetries)
            near = {"within_m": agent.position_tolerance_m, "within_rad": agent.rotation_tolerance_rad}
            held = checked(belief, truth, agent.model.symmetries, **near)
            steps.append(
                {
                    "contacts": step.contacts,
                    "touched": bool(step.reading.in_contact.any()),
                    "mm": round(float(metres) * 1e3, 2),
                    "deg": round(float(radians) * 180.0 / torch.pi, 2),
                    "p": round(held.p_right, 4),
                    "level": round(held.both, 4),
                    "place": round(held.place, 4),
                    "turn": round(held.turn, 4),
                    "expected": round(step.expected_nll, 2),
                    "nll": round(float(step.nll or 0.0), 2),
                    "cpu_s": round(updates[-1], 4) if step.step else 0.0,
                }
            )

        result = run_to_end(task, agent, seed=seed, on_step=note)
    return {"stopped_by": result.stopped_by, "steps": steps}


STOP_RULES.add(
    "compared",
    lambda settings, now: now.p_right >= 0.98 and now.expected_nll < 5.0 and now.contacts >= settings.contacts,
)
RULES = {
    "P(right) >= .9": lambda s: s["p"] >= 0.9,
    "P(right) >= .95": lambda s: s["p"] >= 0.95,
    "P(right) >= .98": lambda s: s["p"] >= 0.98,
    "expected nll < 5": lambda s: s["expected"] < 5.0,
    "expected nll < 3": lambda s: s["expected"] < 3.0,
}


def right(step: dict[str, Any], task: str) -> bool:
    """As a run of the task is judged."""
    return _near(step, task) and bool(step["nll"] <= find_task(task).nll_threshold)


def _near(step: dict[str, Any], task: str) -> bool:
    """Whether the best pose is within the task's tolerance."""
    spec = find_task(task)
    return bool(
        step["mm"] <= 1e3 * spec.position_tolerance_m and step["deg"] <= 180.0 / torch.pi * spec.rotation_tolerance_rad
    )


def tables(lines: Sequence[dict[str, Any]]) -> str:
    """Markdown: how runs end by rule, and how the beliefs cover."""
    out = [
        "| motion | rule | runs | right | sure and wrong | not sure | P(right) where sure | actions, median "
        "| mm, median; 90 % |",
        "|-" * 9 + "|",
    ]
    covers = [
        "| motion | updates | 50 % | 90 % | 95 % | 99 % | error of P(right) (by chance) | seconds, median; 90 % |",
        "|-" * 8 + "|",
    ]
    for label in dict.fromkeys(_label(line) for line in lines):
        own = [line for line in lines if _label(line) == label]
        chosen = RULES if "trajectory" in label else {"as it is": lambda s: False}
        for name, holds in chosen.items():
            ends = []
            for line in own:
                steps = line["steps"]
                sure = [k for k, s in enumerate(steps) if s["contacts"] > 0 and holds(s)]
                stopped = bool(sure) or (name == "as it is" and line["stopped_by"] == "sure")
                ends.append((sure[0] if sure else len(steps) - 1, stopped, steps))
            good = sum(right(steps[k], own[0]["part"]) for k, _, steps in ends)
            wrong = sum(stopped and not right(steps[k], own[0]["part"]) for k, stopped, steps in ends)
            unsure = sum(not stopped for _, stopped, _ in ends)
            own_p = statistics.mean([steps[k]["p"] for k, stopped, steps in ends if stopped] or [math.nan])
            off = sorted(steps[k]["mm"] for k, _, steps in ends)
            actions = statistics.median(k for k, _, _ in ends)
            far = off[min(len(off) - 1, int(0.9 * len(off)))]
            out.append(
                f"| {label} | {name} | {len(own)} | {good} | {wrong} | {unsure} | {own_p:.3f} | {actions:g} "
                f"| {statistics.median(off):.1f}; {far:.1f} |"
            )
        after = [s for line in own for s in line["steps"] if s["contacts"] > 0]
        held = [sum(s["level"] <= p for s in after) / max(1, len(after)) for p in (0.5, 0.9, 0.95, 0.99)]
        cpu = sorted(s["cpu_s"] for s in after if s["touched"])
        p, near = [s["p"] for s in after], [_near(s, own[0]["part"]) for s in after]
        looks = [(k, s["contacts"]) for k, line in enumerate(own) for s in line["steps"] if s["contacts"] > 0]
        errs = f"{calibration_error(p, near):.3f} ({chance_error(p, groups=looks):.3f})"
        shares = " | ".join(f"{h:.2f}" for h in held)
        covers.append(
            f"| {label} | {len(after)} | {shares} | {errs} "
            f"| {statistics.median(cpu):.2f}; {cpu[int(0.9 * (len(cpu) - 1))]:.2f} |"
        )
    return "\n".join((*out, "", *covers))


def _label(line: dict[str, Any]) -> str:
    return " ".join((line["motion"], *line["set"]))


def main() -> None:
    """Run what is missing, then print."""
    options = tyro.cli(Options, description=__doc__)
    first, _, last = options.seeds.partition("-")
    store = Store(options.results)
    for seed in range(int(first), int(last or first) + 1):
        for motion in options.motions:
            own = options.set if motion == "trajectory" else ()
            settings = {"part": options.task, "motion": motion, "set": list(own), "seed": seed, "steps": options.steps}
            if motion == "trajectory":
                settings["defaults"] = DEFAULTS
            if not options.only_print:
                store.measure(settings, lambda motion=motion, seed=seed: measured(options, motion, seed))
    seeds = range(int(first), int(last or first) + 1)
    lines = [line for line in store.of(options.task) if line["seed"] in seeds]
    print(tables([line for line in lines if line["motion"] != "trajectory" or line.get("defaults") == DEFAULTS]))


if __name__ == "__main__":
    script(main)
