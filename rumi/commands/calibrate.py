"""The command `rumi calibrate`: whether a task's beliefs mean what they say, over many episodes."""

import hashlib
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

import tyro

from rumi import loop
from rumi.cache import cache_folder
from rumi.commands.run import parse
from rumi.commands.tasks import listing
from rumi.errors import UsageError
from rumi.exit_codes import BAD_INPUT, DONE
from rumi.metrics.calibration import (
    SHARES,
    calibration_error,
    chance_error,
    checked,
    covered,
    fitted_odds,
    rank_test,
)
from rumi.records import StepRecord
from rumi.runs.jsonlines import append_line, check_writable, read_lines
from rumi.runs.progress import say
from rumi.tasks.registry import TaskEntry
from sdf.extras import optional

S = TypeVar("S")

_HELP = """\
usage: rumi calibrate TASK [options]

Hold a task's beliefs against the truth over many simulated episodes: coverage of regions, P(right), ranks. `rumi
calibrate TASK --help` lists all settings with their defaults. The tasks:

"""
_SURE = 0.95


@dataclass(frozen=True)
class CalibrateOptions(Generic[S]):
    """Options of `rumi calibrate`.

    Attributes:
        settings: of the episodes; `seed` is the first one's.
        preset: where the settings start from.
        episodes: how many, with one seed after the other.
        out: file of JSON lines, one an episode; those that it has are not run again. By default one in runs/.
        figure: picture of it.
    """

    settings: Annotated[S, tyro.conf.arg(name="")]
    preset: str = "default"
    episodes: int = 20
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    figure: Annotated[Path | None, tyro.conf.arg(metavar="PNG")] = None


def calibrate(arguments: Sequence[str]) -> int:
    """`rumi calibrate`: 0 when the episodes are there and reported, 2 for bad input; Ctrl-C leaves those that ended."""
    if not arguments or arguments[0] in ("-h", "--help"):
        (sys.stdout if arguments else sys.stderr).write(_HELP + listing())
        return DONE if arguments else BAD_INPUT
    name, entry, options = parse(arguments, "calibrate", CalibrateOptions)
    settings = options.settings
    if entry.records or not hasattr(settings, "filter"):
        raise UsageError(f"Expected a task that rummages for a pose, got {name}: its belief is of another kind")
    if options.episodes < 1:
        raise UsageError(f"Expected --episodes of 1 or more, got {options.episodes}")
    if options.figure is not None:
        optional("matplotlib", "A figure")
        check_writable(options.figure)
    entry.check(settings)
    path = options.out or Path("runs") / f"calibration-{name}.jsonl"
    check_writable(path)
    if path.is_file() and path.stat().st_size and not any(read_lines(path)):
        raise UsageError(f"Expected --out to be new, or to hold episodes of before, got {path}, which holds none")
    mark = hashlib.sha256(repr(replace(settings, seed=0)).encode()).hexdigest()[:12]
    there = {
        line["seed"]: line
        for line, _ in read_lines(path)
        # files of before hold episodes that Ctrl-C cut off
        if (line.get("task"), line.get("mark")) == (name, mark) and line.get("stopped_by") != "interrupted"
    }
    seeds = range(settings.seed, settings.seed + options.episodes)
    for number, seed in enumerate(seeds):
        if seed not in there:
            line = {"task": name, "mark": mark, "seed": seed, **episode(entry, replace(settings, seed=seed))}
            append_line(path, line)
            there[seed] = line
            say(f"{number + 1} of {options.episodes}: seed {seed}, {line['stopped_by']}")
    lines = [there[seed] for seed in seeds]
    sys.stdout.write(report(name, lines) + f"  file       {path}\n")
    if options.figure is not None:
        from rumi.viz.calibration import calibration_figure

        beliefs = after_contact(lines)
        levels = {part: [own[part] for own in beliefs] for part in ("place", "turn", "both")}
        p_right, right = [own["p_right"] for own in beliefs], [own["right"] for own in beliefs]
        calibration_figure(levels, p_right, right, last_ranks(lines), options.figure)
        sys.stdout.write(f"  figure     {options.figure}\n")
    return DONE


def episode(entry: TaskEntry[Any], settings: Any) -> dict[str, Any]:  # noqa: ANN401  (of the task's own kind)
    """One episode: each of its beliefs against the truth, and how it ended."""
    steps: list[dict[str, Any]] = []
    with entry.build(settings, cache_dir=cache_folder()) as (task, agent):

        def note(step: StepRecord) -> None:
            if step.truth is None:
                raise UsageError("Expected a task that tells the truth, got none")
            found = checked(
                step.belief,
                step.truth,
                agent.model.symmetries,
                within_m=agent.position_tolerance_m,
                within_rad=agent.rotation_tolerance_rad,
            )
            steps.append({"contacts": step.contacts, **found._asdict()})

        result = loop.run_to_end(task, agent, seed=settings.seed, steps=entry.steps(settings), on_step=note)
    return {"stopped_by": result.stopped_by, "steps": steps}


def looks(lines: Sequence[Mapping[str, Any]]) -> list[tuple[int, int]]:
    """Of each belief of `after_contact` the episode and its contacts: between two contacts it is the same one."""
    return [(k, step["contacts"]) for k, line in enumerate(lines) for step in line["steps"] if step["contacts"] > 0]


def after_contact(lines: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The beliefs of all steps from the first contact on."""
    return [step for line in lines for step in line["steps"] if step["contacts"] > 0]


def last_ranks(lines: Sequence[Mapping[str, Any]]) -> dict[str, list[float]]:
    """Ranks of the truth in the last belief of each episode that touched the object, by coordinate."""
    ranks: dict[str, list[float]] = {}
    for line in lines:
        if line["steps"] and line["steps"][-1]["contacts"] > 0:
            for name, rank in line["steps"][-1]["ranks"].items():
                ranks.setdefault(name, []).append(rank)
    return ranks


def report(name: str, lines: Sequence[Mapping[str, Any]]) -> str:
    """What the episodes say, for people."""
    beliefs = after_contact(lines)
    ends = [(line["stopped_by"] == "sure", line["steps"][-1]["right"]) for line in lines]
    good, wrong = sum(right for _, right in ends), sum(sure and not right for sure, right in ends)
    out = [f"{name}: {len(lines)} episodes, {good} right at the end, {wrong} stopped sure and wrong"]
    if not beliefs:
        return out[0] + ", none touched the object\n"
    out.append(f"beliefs    {len(beliefs)} from the first contact on")
    for part in ("place", "turn", "both"):
        held = [f"{share:.0%} {covered([own[part] for own in beliefs], share):.0%}" for share in SHARES]
        out.append(f"{part:<11}regions hold the truth: " + ", ".join(held))
    p_right, right = [own["p_right"] for own in beliefs], [own["right"] for own in beliefs]
    sure = [own["right"] for own in beliefs if own["p_right"] >= _SURE]
    out.append(
        f"P(right)   expected calibration error {calibration_error(p_right, right):.3f}, by chance alone "
        f"{chance_error(p_right, groups=looks(lines)):.3f}; of {len(sure)} with {_SURE} or more {sum(sure)} right"
    )
    fitted = fitted_odds(p_right, right, groups=[episode for episode, _ in looks(lines)])
    if fitted is not None:
        between = f"({fitted.low:.2f} to {fitted.high:.2f})"
        out.append(f"{'':<11}odds of being right are {fitted.ratio:.2f} {between} times its own")
    tests = {coordinate: rank_test(own) for coordinate, own in last_ranks(lines).items()}
    said = ", ".join(f"{coordinate} {value:.2g}" for coordinate, value in tests.items())
    few = "" if len(lines) >= 50 else " (too few episodes to tell)"
    out.append(f"ranks      of the last beliefs even, P-value: {said or math.nan}{few}")
    return "\n  ".join(out) + "\n"
