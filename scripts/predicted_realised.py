"""Set what single actions were expected to do against what they did, by method, information mode and push model.

    python scripts/predicted_realised.py run        # resumes; one line a run in scripts/results/prediction.jsonl
    python scripts/predicted_realised.py show       # Markdown, with 95 % intervals over whole runs
    python scripts/predicted_realised.py show --touching
    python scripts/predicted_realised.py folder runs/mug-0-rumi-default-s0

Every mode and push model is asked about the same actions, the executed ones, from the beliefs before them. Tune on
seeds of 1000 and more; seeds 0-9 are for the record.
"""

import math
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, get_args

import torch
import tyro
from tqdm import tqdm

from rumi import loop
from rumi.cli import script
from rumi.dynamics.displacement import Hazard
from rumi.dynamics.registry import PushModels
from rumi.fields.information import InformationMode
from rumi.records import StepRecord
from rumi.runs.folder import load_run
from rumi.runs.jsonlines import append_line, read_lines
from rumi.seeding import split
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.build import build, build_rummager
from rumi.tasks.rummage.scenes import find_task, make_tool
from rumi.tasks.rummage.settings import Settings, from_dict
from scripts.bench.ledger import commit
from scripts.bench.prediction import (
    Situation,
    actions,
    agreement,
    from_plan,
    predicted_of,
    realised,
    realised_of,
    run_spearman,
)
from scripts.reproduce.code import code_hash
from scripts.reproduce.command import seeds_of
from scripts.reproduce.jobs import Job

RESULTS = Path(__file__).resolve().parent / "results" / "prediction.jsonl"
TASKS = ("mug-0", "mug-1", "mug-2")
COLUMNS = ("rumi/default", "rumi/paper", "info-only/default", "reach-only/default")
MODES: tuple[str, ...] = get_args(InformationMode)
HAZARDS: tuple[str, ...] = get_args(Hazard)
Cells = Sequence[str]


@dataclass(frozen=True)
class Run:
    """Do the runs that are missing.

    Attributes:
        columns: method/preset.
        tasks: which tasks.
        seeds: "0-9", or "3,5".
        out: file of results, one JSON line a run.
        set: settings on top of the preset.
    """

    columns: tuple[str, ...] = COLUMNS
    tasks: tuple[str, ...] = TASKS
    seeds: str = "0-9"
    out: Path = RESULTS
    set: tuple[str, ...] = ()


@dataclass(frozen=True)
class Show:
    """Print the tables of the newest code in a file of results.

    Attributes:
        results: the file.
        touching: count actions that touched the object only.
    """

    results: Path = RESULTS
    touching: bool = False


@dataclass(frozen=True)
class Folder:
    """Print the tables of some run folders.

    Attributes:
        runs: folders that `rumi run` wrote.
        touching: count actions that touched the object only.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    touching: bool = False


def judged(steps: Sequence[StepRecord], rummager: Rummager, settings: Settings) -> list[dict[str, Any]]:
    """What was expected of each action of a run, by everything that can be asked, and what it did."""
    found, random = [], split(settings.seed, "judge")
    planner = settings.planner
    for index in actions(steps):
        after = steps[index]
        assert after.control is not None
        planned = from_plan(steps, index)
        row: dict[str, Any] = {"realised": asdict(realised(steps, index, rummager.filter))}
        row["planned"] = None if planned is None else asdict(planned)
        situation = Situation(steps[index - 1], rummager.model, rummager.workspace, rummager.tool)
        row["modes"], row["swept"] = {}, {}
        own = PushModels(planner)
        for mode in MODES:
            information = replace(planner.information, mode=mode)
            row["modes"][mode] = asdict(situation.predict(after.control, information, own))
            row["swept"][mode] = situation.swept(after, information)
        row["pushes"] = _asked(situation, after.control, settings, random)
        found.append(row)
    return found


def _asked(
    situation: Situation, control: torch.Tensor, settings: Settings, random: torch.Generator
) -> dict[str, dict[str, Any] | None]:
    """What every push model expects of an action; None of those that cannot do with the belief."""
    planner = settings.planner
    rollouts = {name: planner.suited(name).rollouts for name in ("displacement", "quasi-static")}
    makers = {name: PushModels(replace(planner, push_model=name)) for name in rollouts}
    asked: dict[str, tuple[PushModels, int]] = {f"{name}, likeliest": (maker, 0) for name, maker in makers.items()}
    for hazard in HAZARDS:
        maker = PushModels(replace(planner, push_model="displacement", push=replace(planner.push, hazard=hazard)))
        asked[f"displacement, mean {hazard}"] = (maker, rollouts["displacement"])
    asked["quasi-static, mean"] = (makers["quasi-static"], rollouts["quasi-static"])
    found: dict[str, dict[str, Any] | None] = {}
    for name, (maker, count) in asked.items():
        try:
            expected = situation.predict(control, planner.information, maker, rollouts=count, generator=random)
            found[name] = asdict(expected)
        except ValueError:
            found[name] = None
    return found


def one_run(settings: Settings) -> list[dict[str, Any]]:
    """Carry out one run and judge its actions."""
    cache = Path(os.environ.get("RUMI_CACHE", Path.home() / ".cache" / "rumi"))
    parts = build(settings, cache_dir=cache)
    steps: list[StepRecord] = []
    most = find_task(settings.task).steps if settings.steps is None else settings.steps
    try:
        loop.run(parts.task, parts.agent, seed=settings.seed, steps=most, on_step=steps.append)
    finally:
        parts.task.close()
    return judged(steps, parts.agent, settings)


def run(options: Run) -> None:
    """Do what is missing, and append each run as it ends."""
    torch.set_num_threads(1)
    code, here = code_hash(("rumi.tasks.rummage.build", "rumi.loop", "scripts.bench.prediction")), commit()
    done = {(r["task"], r["column"], r["seed"], r["settings"], r["code"]) for r, _ in read_lines(options.out)}
    jobs = [
        Job("run", task, *column.split("/"), seed, options.set)
        for seed in seeds_of(options.seeds)
        for task in options.tasks
        for column in options.columns
    ]
    wanted = [job for job in jobs if (job.task, _column(job), job.seed, job.settings_hash, code) not in done]
    for job in tqdm(wanted, file=sys.stderr):
        line = {
            "experiment": "prediction",
            "column": _column(job),
            "task": job.task,
            "seed": job.seed,
            "settings": job.settings_hash,
            "changes": list(job.overrides),
            "code": code,
            "commit": here,
        }
        append_line(options.out, line | {"actions": one_run(job.settings)})


def _column(job: Job) -> str:
    return f"{job.method}/{job.preset}"


def show(options: Show) -> None:
    """Print the tables of a file."""
    runs = [line for line, _ in read_lines(options.results)]
    if not runs:
        raise SystemExit(f"There are no runs in {options.results}: do some with `run` first")
    newest = {}
    for r in runs:
        if r["code"] == runs[-1]["code"]:
            newest[" ".join((r["column"], *r["changes"])), r["task"], r["seed"]] = r["actions"]
    columns: dict[str, list[list[dict[str, Any]]]] = {}
    for (column, _, _), found in newest.items():
        columns.setdefault(column, []).append(found)
    print_tables(columns, options.touching)


def folder(options: Folder) -> None:
    """Print the tables of run folders."""
    torch.set_num_threads(1)
    columns: dict[str, list[list[dict[str, Any]]]] = {}
    for path in options.runs:
        recorded = load_run(path)
        settings = from_dict(recorded.settings)
        spec = find_task(settings.task)
        model = spec.object_factory()
        cache = Path(os.environ.get("RUMI_CACHE", Path.home() / ".cache" / "rumi"))
        tool = make_tool(spec, settings.simulator, cache_dir=cache)
        rummager = build_rummager(spec, settings, model, tool)
        column = f"{settings.method}/{settings.preset}"
        columns.setdefault(column, []).append(judged(recorded.steps, rummager, settings))
    print_tables(columns, options.touching)


def print_tables(columns: dict[str, list[list[dict[str, Any]]]], touching: bool) -> None:
    """All tables: as planned, by information mode, by push model."""
    which = "the actions that touched the object" if touching else "all actions"
    kept = {
        column: [[a for a in one if a["realised"]["touched"] or not touching] for one in runs]
        for column, runs in columns.items()
    }
    print(f"Rank correlations over {which}, with 95 % intervals over whole runs.\n\nAs the plans had it:\n")
    heads = ("method/preset", "runs", "actions", "information predicted and gained", "displacement predicted and true")
    table((*heads, "error, mm (median)", "moves foreseen", "false moves"), _planned(kept))
    print("\nInformation by mode, asked about the same actions (likeliest push):\n")
    heads = ("method/preset", "mode", "predicted and gained", "swept and gained", "predicted and swept")
    table(heads, _modes(kept))
    print("\nDisplacement and information by push model, asked about the same actions:\n")
    heads = ("method/preset", "push model", "displacement predicted and true", "error, mm (median)", "moves foreseen")
    table((*heads, "false moves", "information predicted and gained"), _pushes(kept))


def table(heads: Cells, rows: Iterator[Cells]) -> None:
    """Print a Markdown table."""
    print("| " + " | ".join(heads) + " |\n" + "|---" * len(heads) + "|")
    for row in rows:
        print("| " + " | ".join(row) + " |")


def _planned(columns: dict[str, list[list[dict[str, Any]]]]) -> Iterator[Cells]:
    for column, runs in columns.items():
        pairs = [
            [(predicted_of(a["planned"]), realised_of(a["realised"])) for a in one if a["planned"]] for one in runs
        ]
        found = agreement(pairs)
        if found.actions:
            counts = (str(found.runs), str(found.actions))
            yield (column, *counts, interval(found.information), interval(found.distance), *_moves(found))


def _modes(columns: dict[str, list[list[dict[str, Any]]]]) -> Iterator[Cells]:
    for column, runs in columns.items():
        for mode in MODES:
            known = [[a for a in one if a["swept"][mode] is not None] for one in runs]
            known = [one for one in known if one]
            if not known:
                continue
            expected = [[a["modes"][mode]["information"] for a in one] for one in known]
            swept = [[a["swept"][mode] for a in one] for one in known]
            gained = [[a["realised"]["gained"] for a in one] for one in known]
            pairs = ((expected, gained), (swept, gained), (expected, swept))
            yield (column, mode, *(interval(run_spearman(list(zip(a, b, strict=True)))) for a, b in pairs))


def _pushes(columns: dict[str, list[list[dict[str, Any]]]]) -> Iterator[Cells]:
    for column, runs in columns.items():
        for name in dict.fromkeys(name for one in runs for action in one for name in action["pushes"]):
            pairs = [
                [(predicted_of(a["pushes"][name]), realised_of(a["realised"])) for a in one if a["pushes"][name]]
                for one in runs
            ]
            found = agreement(pairs)
            if found.actions:
                yield (column, name, interval(found.distance), *_moves(found), interval(found.information))


def _moves(found: Any) -> tuple[str, str, str]:  # noqa: ANN401  (an Agreement)
    return (number(1e3 * found.error_m, 1), number(found.pushes, 2), number(found.false_pushes, 2))


def interval(values: tuple[float, float, float]) -> str:
    """A value with its interval."""
    middle, low, high = values
    return "-" if math.isnan(middle) else f"{middle:.2f} [{low:.2f}, {high:.2f}]"


def number(value: float, digits: int) -> str:
    """A number, a dash for none."""
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def main() -> None:
    """Run, show, or tell of a run's folder."""
    commands = {"run": Run, "show": Show, "folder": Folder}
    chosen = tyro.extras.subcommand_cli_from_dict(commands, description=__doc__)
    {Run: run, Show: show, Folder: folder}[type(chosen)](chosen)


if __name__ == "__main__":
    script(main)
