"""Closed loops on drawn scenes by how the object's motion is known: right, sure and wrong, cover of regions, time.

python -m scripts.trajectory_runs --seeds 1000-1019                    # runs what is missing, then prints the tables
python -m scripts.trajectory_runs --motions trajectory --seeds 1000-1009 --set filter.trajectories.across=0.45

A trajectory run goes on until every rule that is compared would have stopped it. Cover is of updates after the first
contact: the truth lies within a region of p where particles of less than p are at denser places, density being that of
the distance to the twelfth neighbour, with 1 mm as 1.5 degrees (`level`).
"""

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from jaxtyping import Float
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.cli import script
from rumi.information.stopping import STOP_RULES
from rumi.loop import run
from rumi.metrics.pose_error import pose_error
from rumi.records import StepRecord
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.scenes import find_task
from rumi.tasks.rummage.settings import Settings, from_dict, preset, to_dict
from scripts.store import Store
from sdf.symmetry import Symmetries

RESULTS = Path(__file__).parent / "results" / "trajectories.jsonl"
Motion = Literal["trajectory", "corrected", "estimated", "pushed", "measured"]
_NEIGHBOURS, _MM, _DEG = 12, 1e3, 180.0 / torch.pi / 1.5


@dataclass(frozen=True)
class Options:
    """What is run.

    Attributes:
        task: that draws its scenes.
        seeds: first and last.
        motions: how the filter knows the motion.
        set: other settings, as name=number.
        steps: actions at most.
        results: file of the figures.
        only_print: run nothing.
    """

    task: str = "mug"
    seeds: str = "1000-1009"
    motions: tuple[Motion, ...] = ("trajectory", "corrected", "measured")
    set: tuple[str, ...] = ()
    steps: int = 25
    results: Path = RESULTS
    only_print: bool = False


def level(belief: PoseBelief, truth: Float[Tensor, "4 4"], symmetries: Symmetries | None = None) -> float:
    """Share of the belief at places denser than the truth's: below p where the truth is in the region of p.

    Args:
        belief: of one scene.
        truth: the true pose.
        symmetries: turns after which the object looks the same.
    """
    poses, weights = belief.world_T_object.double(), belief.log_weights.double().softmax(-1)
    all_, turns = torch.cat((poses, truth.double()[None])), torch.eye(3, dtype=torch.float64)[None]
    if symmetries is not None:
        turns = symmetries.rotations.double()
    off = torch.cdist(all_[:, :3, 3], poses[:, :3, 3], compute_mode="donot_use_mm_for_euclid_dist")
    turned = poses[None, :, :3, :3] @ turns[:, None]
    cosine = 0.5 * (torch.einsum("iab,sjab->sij", all_[:, :3, :3], turned).amax(0) - 1.0)
    apart = torch.hypot(_MM * off, _DEG * cosine.clamp(-1.0, 1.0).arccos())
    apart[: len(poses)].fill_diagonal_(torch.inf)  # nothing is its own neighbour
    order = apart.argsort(-1)
    mass = weights[order].cumsum(-1)
    place = (mass >= _NEIGHBOURS / len(poses)).to(torch.uint8).argmax(-1, keepdim=True)
    radius = apart.gather(-1, order).gather(-1, place)[:, 0]
    return float(weights[radius[:-1] < radius[-1]].sum())


def settings_of(options: Options, motion: str, seed: int) -> Settings:
    """Of one run."""
    most = min(options.steps, find_task(options.task).steps)  # as on the shelf, where 15 are allowed
    settings = preset("default", task=options.task, seed=seed, steps=most)
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
    if motion != "measured":
        settings = replace(settings, simulator=replace(settings.simulator, measures_motion=False))
    return settings


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
            steps.append(
                {
                    "contacts": step.contacts,
                    "touched": bool(step.reading.in_contact.any()),
                    "mm": round(float(metres) * 1e3, 2),
                    "deg": round(float(radians) * 180.0 / torch.pi, 2),
                    "p": round(
                        belief.probability_right(
                            agent.model.symmetries,
                            within_m=agent.position_tolerance_m,
                            within_rad=agent.rotation_tolerance_rad,
                        ),
                        4,
                    ),
                    "level": round(level(belief, truth, agent.model.symmetries), 4),
                    "expected": round(step.expected_nll, 2),
                    "nll": round(float(step.nll or 0.0), 2),
                    "cpu_s": round(updates[-1], 4) if step.step else 0.0,
                }
            )

        result = run(task, agent, seed=seed, on_step=note)
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
    spec = find_task(task)
    near = (
        step["mm"] <= 1e3 * spec.position_tolerance_m and step["deg"] <= 180.0 / torch.pi * spec.rotation_tolerance_rad
    )
    return bool(near and step["nll"] <= spec.nll_threshold)


def tables(lines: Sequence[dict[str, Any]]) -> str:
    """Markdown: how runs end by rule, and how the beliefs cover."""
    out = [
        "| motion | rule | runs | right | sure and wrong | not sure | actions, median | mm, median; 90 % |",
        "|-" * 8 + "|",
    ]
    covers = [
        "| motion | updates | 50 % | 90 % | 95 % | 99 % | error of P(right) | seconds, median; 90 % |",
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
            off = sorted(steps[k]["mm"] for k, _, steps in ends)
            actions = statistics.median(k for k, _, _ in ends)
            far = off[min(len(off) - 1, int(0.9 * len(off)))]
            out.append(
                f"| {label} | {name} | {len(own)} | {good} | {wrong} | {unsure} | {actions:g} "
                f"| {statistics.median(off):.1f}; {far:.1f} |"
            )
        after = [s for line in own for s in line["steps"] if s["contacts"] > 0]
        held = [sum(s["level"] <= p for s in after) / max(1, len(after)) for p in (0.5, 0.9, 0.95, 0.99)]
        cpu = sorted(s["cpu_s"] for s in after if s["touched"])
        shares = " | ".join(f"{h:.2f}" for h in held)
        covers.append(
            f"| {label} | {len(after)} | {shares} | {calibration(after, own[0]['part']):.3f} "
            f"| {statistics.median(cpu):.2f}; {cpu[int(0.9 * (len(cpu) - 1))]:.2f} |"
        )
    return "\n".join((*out, "", *covers))


def calibration(steps: Sequence[dict[str, Any]], task: str = "mug", bins: int = 10) -> float:
    """Expected calibration error of P(right)."""
    spec, total = find_task(task), 0.0
    within_mm, within_deg = 1e3 * spec.position_tolerance_m, 180.0 / torch.pi * spec.rotation_tolerance_rad
    for k in range(bins):
        own = [s for s in steps if k <= min(s["p"] * bins, bins - 1e-9) < k + 1]
        if own:
            good = sum(s["mm"] <= within_mm and s["deg"] <= within_deg for s in own)
            total += abs(sum(s["p"] for s in own) - good)
    return total / max(1, len(steps))


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
            if not options.only_print:
                store.measure(settings, lambda motion=motion, seed=seed: measured(options, motion, seed))
    seeds = range(int(first), int(last or first) + 1)
    print(tables([line for line in store.of(options.task) if line["seed"] in seeds]))


if __name__ == "__main__":
    script(main)
