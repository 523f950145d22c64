"""Set what single actions were expected to do against what they did, by method, information mode and push model.

    python -m scripts.predicted_realised run        # resumes; one line a run in scripts/results/prediction.jsonl
    python -m scripts.predicted_realised show       # Markdown, with 95 % intervals over whole runs
    python -m scripts.predicted_realised touching                # of the actions that touched the object only
    python -m scripts.predicted_realised folder runs/mug-0-rumi-default-s0

All modes and push models are asked about the same actions, the executed ones, from the beliefs before them; of tasks
in space, whose fields are dear, the run's own mode alone, and of touch-box, which has no fields, its particles alone.
Tune on seeds of 1000 and more; seeds 0-9 are for the record.
"""

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, get_args

import torch
import tyro
from jaxtyping import Float
from torch import Tensor

from rumi import loop
from rumi.belief.trajectory_belief import TrajectoryBelief
from rumi.cache import cache_folder
from rumi.cli import script
from rumi.dynamics.displacement_rollouts import Hazard
from rumi.dynamics.registry import PushModels
from rumi.fields.information import InformationMode
from rumi.records import StepRecord
from rumi.runs.folder import load_run
from rumi.seeding import split
from rumi.task import StepResult
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.build import build, build_rummager
from rumi.tasks.rummage.motions import with_eye
from rumi.tasks.rummage.scenes import find_task, make_tool
from rumi.tasks.rummage.settings import Settings, from_dict
from rumi.tasks.touch_box.agent import Toucher, TouchState
from rumi.tasks.touch_box.build import build_touch_box
from rumi.tasks.touch_box.scene import TouchTask
from rumi.tasks.touch_box.settings import TouchSettings
from scripts.bench.prediction import (
    Predicted,
    Situation,
    actions,
    agreement,
    from_plan,
    predicted_of,
    realised,
    realised_of,
    run_spearman,
)
from scripts.experiment import RESULTS, Experiment, Line
from scripts.reproduce.cells import table
from scripts.reproduce.code import code_of
from scripts.reproduce.jobs import Job
from scripts.reproduce.touch_report import digest
from scripts.store import Store

TOUCH = "touch-box"
TASKS = (*(f"{kind}-{number}" for kind in ("mug", "drill", "box") for number in range(3)), TOUCH)
COLUMNS = ("rumi/default", "rumi/paper", "info-only/default", "reach-only/default", "sequence/default")
"""Method and preset; the last is of touch-box alone."""
MODES: tuple[str, ...] = get_args(InformationMode)
HAZARDS: tuple[str, ...] = get_args(Hazard)
Cells = Sequence[str]


@dataclass(frozen=True)
class Touching:
    """Print the tables over the actions that touched the object.

    Attributes:
        results: the file.
    """

    results: Path = RESULTS / "prediction.jsonl"


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
        for mode in (planner.information.mode,) if rummager.tool.spatial else MODES:
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
    drawn = replace(planner, push_model="quasi-static", push_parameters="prior")
    asked["quasi-static, mean of the prior's draws"] = (PushModels(drawn), rollouts["quasi-static"])
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
    parts = build(settings, cache_dir=cache_folder())
    steps: list[StepRecord] = []
    most = find_task(settings.task).steps if settings.steps is None else settings.steps
    try:
        loop.run_to_end(parts.task, parts.agent, seed=settings.seed, steps=most, on_step=steps.append)
    finally:
        parts.task.close()
    return judged(steps, parts.agent, settings)


class _Judged:
    """The agent of touch-box, which notes how its particles would be pushed along each path that was carried out."""

    def __init__(self, agent: Toucher) -> None:
        self.agent = agent
        self.actions: list[dict[str, Any]] = []

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        return getattr(self.agent, name)

    def update(self, state: TouchState, action: object, result: StepResult) -> TouchState:
        """As the agent's, and a line on what was foreseen and what came true."""
        belief, path, truth = state.belief, result.reading.path, state.record.truth
        true = replace(belief, pose=truth.expand_as(belief.pose))
        expected = {name: self._expected(own, path) for name, own in (("belief", belief), ("true pose", true))}
        after = self.agent.update(state, action, result)
        u, v = (after.record.truth - truth)[:2].tolist()
        moved = math.hypot(u, v) > 1e-3  # readings err, so that one in each poke or two is of a contact
        came = {"gained": 0.0, "drop": 0.0, "displacement_m": (u, v, 0.0), "touched": moved}
        pushes = {f"quasi-static, particles, {name}": own for name, own in expected.items()}
        self.actions.append(
            {"realised": came, "planned": expected["belief"], "modes": {}, "swept": {}, "pushes": pushes}
        )
        return after

    def _expected(self, belief: TrajectoryBelief, path: Float[Tensor, "K1 3"]) -> dict[str, Any]:
        rows = torch.arange(belief.pose.shape[1])
        states = self.agent.rollouts(belief, path[None], rows)[0].states[0]
        x, y = (belief.log_weights[0].exp() @ (states[-1] - states[0])[:, :2]).tolist()
        return asdict(Predicted(0.0, (x, y, 0.0)))


def one_touch_run(seed: int) -> list[dict[str, Any]]:
    """Carry out one run of touch-box by its default, and judge its pokes."""
    with build_touch_box(TouchTask(), TouchSettings(), "gripper", cache_dir=cache_folder()) as (task, agent):
        judge = _Judged(agent)
        loop.run_to_end(task, judge, seed=seed)
    return judge.actions


def job(column: str, task: str, seed: int, changes: tuple[str, ...]) -> Job:
    """The run of a variant."""
    return Job("run", task, *column.split("/"), seed, changes)


def measure(column: str, task: str, seed: int, changes: tuple[str, ...]) -> dict[str, Any]:
    """What was expected of each action of a run, and what it did."""
    if task == TOUCH:
        return {"actions": one_touch_run(seed)}
    return {"actions": one_run(job(column, task, seed, changes).settings)}


def identity(variant: dict[str, Any]) -> dict[str, Any]:
    """Hashes of all settings and of the code."""
    if variant["task"] == TOUCH:
        own = digest(TouchTask(), TouchSettings(), "gripper")
        return {"experiment": "prediction", "changes": [], "settings": own, "code": code_of("touch-box")}
    hashes = {"settings": job(**variant).settings_hash, "code": code_of("prediction")}
    return {"experiment": "prediction", "changes": list(variant["changes"]), **hashes}


def show(lines: list[Line], chosen: Mapping[str, tuple[str, ...]], *, touching: bool = False) -> str:
    """The tables of the newest code, by kind of task."""
    if not lines:
        raise SystemExit("There are no runs: do some with `run` first")
    codes = {r["task"] == TOUCH: r["code"] for r in lines}
    newest = {}
    for r in lines:
        if r["code"] == codes[r["task"] == TOUCH]:
            kind = TOUCH if r["task"] == TOUCH else r["task"].split("-")[0]
            newest[" ".join((kind, r["column"], *r["changes"])), r["task"], r["seed"]] = r["actions"]
    columns: dict[str, list[list[dict[str, Any]]]] = {}
    for (column, _, _), found in newest.items():
        columns.setdefault(column, []).append(found)
    return tables(columns, touching)


def touching(options: Touching) -> None:
    """Print the tables of the newest code."""
    sys.stdout.write(show(Store(options.results).flat(), {}, touching=True))


def folder(options: Folder) -> None:
    """Print the tables of run folders."""
    torch.set_num_threads(1)
    columns: dict[str, list[list[dict[str, Any]]]] = {}
    for path in options.runs:
        recorded = load_run(path)
        settings = from_dict(recorded.settings)
        spec = find_task(settings.task)
        settings = replace(settings, filter=with_eye(spec, settings.filter))
        model = spec.object_factory()
        tool = make_tool(spec, settings.simulator, cache_dir=cache_folder())
        rummager = build_rummager(spec, settings, model, tool)
        column = f"{settings.method}/{settings.preset}"
        columns.setdefault(column, []).append(judged(recorded.steps, rummager, settings))
    sys.stdout.write(tables(columns, options.touching))


def tables(columns: dict[str, list[list[dict[str, Any]]]], touching: bool) -> str:
    """All tables: as planned, by information mode, by push model."""
    which = "the actions that touched the object" if touching else "all actions"
    kept = {
        column: [[a for a in one if a["realised"]["touched"] or not touching] for one in runs]
        for column, runs in columns.items()
    }
    ends = ("error, mm (median)", "moves foreseen", "false moves")
    heads = (
        "task, method/preset",
        "runs",
        "actions",
        "information predicted and gained",
        "displacement predicted and true",
    )
    modes = ("task, method/preset", "mode", "predicted and gained", "swept and gained", "predicted and swept")
    pushes = ("task, method/preset", "push model", "displacement predicted and true", *ends)
    return (
        f"Rank correlations over {which}, with 95 % intervals over whole runs.\n\nAs the plans had it:\n\n"
        f"{table((*heads, *ends), _planned(kept))}\n"
        "Information by mode, asked about the same actions (likeliest push):\n\n"
        f"{table(modes, _modes(kept))}\n"
        "Displacement and information by push model, asked about the same actions:\n\n"
        f"{table((*pushes, 'information predicted and gained'), _pushes(kept))}"
    )


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
            known = [[a for a in one if a["swept"].get(mode) is not None] for one in runs]
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


EXPERIMENT = Experiment(
    __doc__,
    "prediction.jsonl",
    {"task": TASKS, "column": COLUMNS},
    measure,
    show,
    seeds="0-9",
    parameters={"changes": ()},
    identity=identity,
    possible=lambda variant: (variant["task"] == TOUCH) == (variant["column"] == COLUMNS[-1]),
    commands={"touching": (Touching, touching), "folder": (Folder, folder)},
)

if __name__ == "__main__":
    script(EXPERIMENT.main)
