"""`rumi reproduce touch-...`: the tables and figures of the touch-only paper, beside the paper's own."""

import itertools
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from rumi import loop
from rumi.errors import UsageError
from rumi.exit_codes import DONE
from rumi.runs.folder import make_folder
from rumi.runs.jsonlines import check_writable
from rumi.tasks.touch_box.build import Robot, build_touch_box
from rumi.tasks.touch_box.scene import TouchTask
from rumi.tasks.touch_box.selection import METHODS
from rumi.tasks.touch_box.settings import TouchSettings
from scripts.reproduce.code import code_of
from scripts.reproduce.seeds import seeds_of
from scripts.reproduce.touch_report import Line, calibration, digest, table
from scripts.store import Store

EXPERIMENTS = ("touch-table1", "touch-table2", "touch-fig3", "touch-fig4")
PART = "touch-box"
_FILES = ("--out", "--results", "--markdown")

_HELP = """Run the touch-only paper's experiments on this simulator, and print our figures beside the paper's.

    rumi reproduce touch-table1 --seeds 0-99
    rumi reproduce touch-table1 --methods sequence entropy --settings.threshold 0.8 --seeds 1000-1029
    rumi reproduce touch-table1 touch-fig3 --results scripts/results/touch.jsonl --show
    rumi reproduce touch-table2 touch-fig4

Runs are kept, one line each, and done once: give the command again to go on. Experiments: {names}."""

_PAPER_TABLE1 = (
    "The paper (a real arm, 30 runs): proposed 0.8 [0.63, 0.90] lifted after 9.4 (3.5) actions, uninformed 0.23 "
    "[0.12, 0.41] after 12.5 (3.7), max-contact 0.33 [0.19, 0.51] after 13.8 (2.8)."
)


@dataclass(frozen=True)
class TouchReproduceOptions:
    """Options of `rumi reproduce touch-...`.

    Attributes:
        experiments: tables and figures.
        methods: by which pokes are chosen, in the order of the table; the others are paired with the first.
        push_models: by which particles are moved.
        robot: that pokes and grasps.
        seeds: of the runs, such as 0-99; the record has these, tuning starts from 1000.
        settings: of the runs, but for method and push model.
        task: the scene and its readings.
        runs: pushes of touch-table2.
        out: folder of results and figures.
        results: file of the results; by default touch.jsonl in the folder.
        seconds: end after this long, with what there is; give the command again to go on.
        show: run nothing; the tables are over what the file holds, whatever code it was.
    """

    experiments: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="WHAT ...")]
    methods: tuple[str, ...] = tuple(METHODS)
    push_models: tuple[str, ...] = ("quasi-static",)
    robot: Robot = "gripper"
    seeds: str = "0-99"
    settings: TouchSettings = field(default_factory=TouchSettings)
    task: TouchTask = field(default_factory=TouchTask)
    runs: int = 1000
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("runs/reproduce")
    results: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    seconds: float = float("inf")
    show: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False

    @property
    def path(self) -> Path:
        """File of the results."""
        return self.out / "touch.jsonl" if self.results is None else self.results


def asked_for(arguments: Sequence[str]) -> bool:
    """Whether the experiments of a command line are these: the words before the first flag, or known names later."""
    first = itertools.takewhile(lambda argument: not argument.startswith("-"), arguments)
    later = (name for flag, name in itertools.pairwise(arguments) if flag not in _FILES)
    return any(word.startswith("touch-") for word in first) or any(name in EXPERIMENTS for name in later)


def reproduce_touch(arguments: Sequence[str], *, cache_dir: Path | None) -> int:
    """Carry out `rumi reproduce touch-...`."""
    options = tyro.cli(
        TouchReproduceOptions,
        prog="rumi reproduce",
        description=_HELP.format(names=", ".join(EXPERIMENTS)),
        args=arguments,
    )
    for name in options.experiments:
        if name not in EXPERIMENTS:
            raise UsageError(
                f"There is no experiment {name!r} of touch; there are {', '.join(EXPERIMENTS)}: "
                "the touch-* experiments are given by themselves"
            )
    for name in options.methods:
        if name not in METHODS:
            raise UsageError(f"There is no method {name!r}; there are {', '.join(METHODS)}")
    if not options.show and {"touch-table1", "touch-fig3"} & set(options.experiments):
        check_writable(options.path)
    if {"touch-fig3", "touch-fig4"} & set(options.experiments):
        make_folder(options.out)
    for name in options.experiments:
        _say(f"## {name}\n\n{_WORK[name](options, cache_dir)}\n")
    return DONE


def _columns(options: TouchReproduceOptions) -> dict[str, TouchSettings]:
    """The settings of each line of Table I, by its name."""
    found = {}
    for push in options.push_models:
        for method in options.methods:
            name = method if len(options.push_models) == 1 else f"{method}, {push}"
            found[name] = replace(options.settings, method=method, push_model=push)
    return found


def run_all(options: TouchReproduceOptions, cache_dir: Path | None) -> dict[str, list[Line]]:
    """All runs of Table I, each once; what the file holds, where nothing is to be run."""
    import time

    begun, store, columns = time.monotonic(), Store(options.path), _columns(options)
    code = code_of(PART)
    if not options.show:
        for seed in seeds_of(options.seeds):
            for name, settings in columns.items():
                if time.monotonic() - begun > options.seconds:
                    break
                asked = {
                    "part": PART,
                    "seed": seed,
                    "method": settings.method,
                    "push_model": settings.push_model,
                    "robot": options.robot,
                    "settings": digest(options.task, settings, options.robot),
                    "code": code,
                }

                def work(settings: TouchSettings = settings, seed: int = seed) -> Line:
                    with build_touch_box(options.task, settings, options.robot, cache_dir=cache_dir) as parts:
                        return loop.run_to_end(*parts, seed=seed).as_dict()

                if store.measure(asked, work):
                    sys.stderr.write(f"rumi: seed {seed}, {name}\n")
    groups: dict[str, list[Line]] = {}
    seeds = set(seeds_of(options.seeds))
    for name, settings in columns.items():
        wanted = digest(options.task, settings, options.robot)
        own = [line for line in store.of(PART) if line["settings"] == wanted and line["seed"] in seeds]
        if not options.show:
            own = [line for line in own if line["code"] == code]
        groups[name] = list({line["seed"]: line for line in own}.values())
    return groups


def _table1(options: TouchReproduceOptions, cache_dir: Path | None) -> str:
    groups = run_all(options, cache_dir)
    if not any(groups.values()):
        raise UsageError(f"{options.path} holds no runs with these settings: leave out --show to run")
    first = next(own for own in groups.values() if own)
    every = [line for own in groups.values() for line in own]
    name = next(name for name, own in groups.items() if own)
    return (
        f"{table(groups)}\n\n{_PAPER_TABLE1}\n\nCalibration of {name}:\n\n{calibration(first)}\n\n"
        f"Calibration of all runs:\n\n{calibration(every)}"
    )


def _table2(options: TouchReproduceOptions, cache_dir: Path | None) -> str:
    from scripts.bench.touch_filters import PAPER, compare, markdown

    return f"{markdown(compare(runs=options.runs))}\n\n{PAPER}"


def _fig3(options: TouchReproduceOptions, cache_dir: Path | None) -> str:
    from scripts.reproduce.touch_figures import draw_times

    groups = {name: own for name, own in run_all(options, cache_dir).items() if own}
    path = options.out / "touch-fig3.png"
    text = draw_times(groups, path)
    return f"{text}\n\nfigure: {os.path.relpath(path)}"


def _fig4(options: TouchReproduceOptions, cache_dir: Path | None) -> str:
    from scripts.reproduce.touch_figures import draw_filters

    path = options.out / "touch-fig4.png"
    draw_filters(path)
    return f"figure: {os.path.relpath(path)}"


_WORK = {"touch-table1": _table1, "touch-table2": _table2, "touch-fig3": _fig3, "touch-fig4": _fig4}


def _say(text: str) -> None:
    sys.stdout.write(text.rstrip("\n") + "\n\n")
    sys.stdout.flush()
