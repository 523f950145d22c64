"""The command `rumi run peg`."""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from rumi.errors import UsageError
from rumi.exit_codes import DONE, NOT_CONVERGED
from rumi.runs.folder import free_folder, left_if_begun, prepare_folder
from rumi.tasks.peg.agent import PegRun, run_peg
from rumi.tasks.peg.settings import PegSettings, Stop

NAME = "peg"
DESCRIPTION = "a block with two holes on a table, found by touch under a deadline, and a peg put into it"
"""What the task is, for the list of tasks."""

_HELP = """Find a block on a table by touch, deciding where to touch next in the time there is, and put a peg into it.

    rumi run peg --t-max 10
    rumi run peg --t-max 20 --stop contacts --seed 3
    rumi run peg --t-max 10 --evaluation real --set point_m=0.001 normal_deg=2

Time passes on a simulated clock: thinking takes what --evaluation says, motion what its speed profile does. An option
and --set that do not agree are refused."""


@dataclass(frozen=True)
class PegOptions:
    """Options of `rumi run peg`.

    Attributes:
        t_max: seconds for a decision and its motion together; 10 unless --set gives t_max_s.
        evaluation: seconds that weighing one candidate takes, or "real" for what choosing takes on this machine; 1
            unless --set gives evaluation_s.
        stop: "mass" (as it is unless --set gives stop) stops where both holes are within 5 mm with a probability of
            0.95, "contacts" after four contacts on two sides, as the paper does, "covariance" where the pose's spread
            is at most spread_m and spread_deg, "entropy" where its entropy is at most most_nats.
        seed: of the block's pose, the noise and the choices.
        set: other settings of the task, such as point_m=0.001; see rumi/tasks/peg/settings.py.
        out: folder of the run; by default runs/peg-tT_MAX-STOP-sSEED, with a number where that is taken.
        figures: draw contacts and time-line.
    """

    t_max: float | None = None
    evaluation: str | None = None
    stop: Stop | None = None
    seed: int = 0
    set: Annotated[tuple[str, ...], tyro.conf.arg(metavar="SETTING=VALUE ...")] = ()
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    figures: bool = True


def peg(arguments: Sequence[str], *, cache_dir: Path | None = None) -> int:
    """Carry out `rumi run peg`; nothing of it needs to be kept in a cache."""
    options = tyro.cli(PegOptions, prog="rumi run peg", description=_HELP, args=arguments)
    if options.seed < 0:
        raise UsageError(f"Expected --seed of 0 or more, got {options.seed}")
    settings = settings_of(options)
    folder = options.out or free_folder(Path("runs") / f"peg-t{settings.t_max_s:g}-{settings.stop}-s{options.seed}")
    prepare_folder(folder)
    with left_if_begun(folder):
        run = run_peg(settings, options.seed)
    (folder / "result.json").write_text(json.dumps(record(run), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    if options.figures:
        draw(run, folder)
    sys.stdout.write(summary(run, folder))
    return DONE if run.stopped_by == "sure" else NOT_CONVERGED


def settings_of(options: PegOptions) -> PegSettings:
    """The settings that are asked for: those of --set, and of options where they are given.

    Raises:
        UsageError: one cannot be, or an option and --set do not say the same.
    """
    from scripts.reproduce.peg import settings_of as parsed

    settings = parsed(options.set)
    given: dict[str, Any] = {"t_max_s": options.t_max, "stop": options.stop}
    given = {name: value for name, value in given.items() if value is not None}
    if options.evaluation is not None:
        try:
            given["evaluation_s"] = None if options.evaluation == "real" else float(options.evaluation)
        except ValueError as error:
            raise UsageError(f"Expected --evaluation to be seconds or real, got {options.evaluation!r}") from error
    flags = {"t_max_s": "--t-max", "stop": "--stop", "evaluation_s": "--evaluation"}
    for name in given.keys() & {override.partition("=")[0] for override in options.set}:
        if given[name] != getattr(settings, name):
            raise UsageError(
                f"Expected one value of {name}, got {given[name]} by {flags[name]} and {getattr(settings, name)} by "
                "--set: leave one of them out"
            )
    return replace(settings, **given)


def record(run: PegRun) -> dict[str, Any]:
    """A run as plain values: how it ended, its settings, and every motion."""
    motions = [
        {
            "kind": ("nothing", "side", "top")[felt.kind],
            "begun_s": felt.begun_s,
            "ended_s": felt.ended_s,
            "path": felt.path.tolist(),
            "point": felt.point.tolist(),
            "normal": felt.normal.tolist(),
        }
        for felt in (*run.searched, *run.felt)
    ]
    decisions = [
        {
            "begun_s": thought.begun_s,
            "ended_s": thought.ended_s,
            "gain": thought.selection.gain,
            "evaluated": thought.selection.evaluated,
            "skipped": thought.selection.skipped,
            "late_s": thought.selection.late_s,
        }
        for thought in run.thoughts
    ]
    return {
        "seed": run.seed,
        "truth": run.truth.tolist(),
        "holes_m": run.aim.points.tolist(),
        **run.as_dict(),
        "settings": run.settings.as_dict(),
        "motions": motions,
        "decisions": decisions,
    }


def draw(run: PegRun, folder: Path) -> None:
    """Contacts and time-line of a run."""
    from rumi.tasks.peg import figures as drawn
    from rumi.viz import style

    with style.figure(9.0, 3.6) as figure:
        whole, close = figure.subplots(1, 2, width_ratios=(1.5, 1.0))
        drawn.draw_contacts(run, whole)
        drawn.draw_contacts(run, close, around_m=0.18)
        figure.savefig(folder / "contacts.png", metadata={"Software": "rumi"})
    with style.figure(9.0, 2.8) as figure:
        one, two = figure.subplots(1, 2)
        drawn.draw_timeline(run, one)
        if run.thoughts:
            drawn.draw_decision(run.thoughts[0], two).set_title("the first decision")
        figure.savefig(folder / "timeline.png", metadata={"Software": "rumi"})


def summary(run: PegRun, folder: Path) -> str:
    """A few lines on how a run ended."""
    ended = {
        "sure": "sure",
        "actions": "not sure",
        "time": "no time for any motion",
        "stay": "nothing more that a touch would tell",
    }[run.stopped_by]
    found = run.as_dict()
    touches = f"{found['touches']} touch{'es' if found['touches'] != 1 else ''}"
    place = "in the hole" if run.in_hole else "beside the hole"
    lines = [f"peg: {ended} after {touches}, {place} by {found['off_mm']:.1f} mm from its middle"]
    within = f"within {1e3 * run.settings.tolerance_m:g}"
    lines.append(
        f"holes    off by {found['hole_error_mm']:.1f} mm at most; believed {found['probability']:.2f} {within}"
    )
    said = f"{found['search_s']:.0f} search, {found['thinking_s']:.0f} reasoning"
    lines.append(f"seconds  {found['total_s']:.0f}: {said}; {found['evaluated']} candidates weighed")
    lines.append(f"folder   {folder}")
    return "\n  ".join(lines) + "\n"
