"""The command `rumi run fused`."""

import contextlib
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from rumi.commands.progress import Progress, both, say, stages
from rumi.errors import UsageError
from rumi.exit_codes import DONE, INTERRUPTED, NOT_CONVERGED

if TYPE_CHECKING:
    from rumi.tasks.handle.log import FusedLogRecorder
    from rumi.tasks.handle.run import Outcome
    from rumi.tasks.handle.settings import FusedSettings, SensorName

NAME = "fused"
DESCRIPTION = "a mug seen once, then felt by bubbles, wrench and joint torques on one belief, and lifted by its handle"
"""What the task is, for the list of tasks."""

_HELP = """Find a movable mug by a first view, soft bubbles, a wrench and joint torques at once, and lift it.

    rumi run fused
    rumi run fused --sensors camera,wrench --seed 3
    rumi run fused --sensors bubbles --budget 30
    rumi run fused --thinking real
    rumi run fused --record

Time passes on the run's own clock: thinking takes what --thinking says, motion what it takes.
Ends with exit code 0 if the mug was lifted, 1 if not."""


@dataclass(frozen=True)
class FusedOptions:
    """Options of `rumi run fused`.

    Attributes:
        sensors: whose evidence counts: all, or some of camera, bubbles, wrench and torques, with commas between.
        seed: of where the mug stands, of the noise and of the choices.
        budget: seconds for it all, the grasp included.
        thinking: seconds that a decision is taken to last, or "real" for what it lasts on this machine.
        steps: actions at most.
        preset: of planner and belief, as of the other runs.
        noise_free: sensors without noise, loss, delay or wrong calibration.
        record: write a log too, log.h5 in the run's folder, for `rumi replay`.
        out: folder of the run; by default runs/fused-SENSORS-sSEED, with a number where that is taken.
        figures: draw figures at the end.
    """

    sensors: str = "all"
    seed: int = 0
    budget: Annotated[float, tyro.conf.arg(metavar="SECONDS")] = 60.0
    thinking: str = "1"
    steps: int = 20
    preset: str = "fast"
    noise_free: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    record: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    figures: bool = True


def fused(arguments: Sequence[str], *, cache_dir: Path | None = None) -> int:
    """Carry out `rumi run fused`; `arguments` are those after the name."""
    options = tyro.cli(FusedOptions, prog=f"rumi run {NAME}", description=_HELP, args=arguments)
    from rumi.commands.run import draw_figures
    from rumi.runs.folder import RunRecorder, free_folder, left_if_begun, prepare_folder, write_json
    from rumi.tasks.handle.build import build_fused
    from rumi.tasks.handle.run import run_fused
    from rumi.tasks.handle.settings import FusedSettings
    from rumi.tasks.rummage.build import scene_sketch
    from rumi.tasks.rummage.settings import preset

    thinking = thinking_of(options.thinking)
    settings = FusedSettings(
        sensors=sensors_of(options.sensors),
        budget_s=options.budget,
        thinking_s=thinking,
        steps=options.steps,
        preset=options.preset,
        noise_free=options.noise_free,
    )
    if options.seed < 0:
        raise UsageError(f"Expected seed to be 0 or more, got {options.seed}")
    preset(options.preset)  # refused before a folder is made
    named = f"{NAME}-{options.sensors.replace(',', '-')}-s{options.seed}"
    folder = options.out or free_folder(Path("runs") / named)
    prepare_folder(folder)
    say(f"{NAME} with {', '.join(settings.sensors)}, seed {options.seed}; writing to {folder}")
    say("grasps are simulated once and kept (a minute at first)")
    if note := short_of(settings):
        say(note)
    with left_if_begun(folder):
        parts = build_fused(settings, cache_dir=cache_dir)
    with (
        RunRecorder(folder, {"task": NAME, "seed": options.seed, "fused": settings}) as recorder,
        _log(folder, options.seed, settings) if options.record else contextlib.nullcontext() as log,
    ):
        recorder.scene(scene_sketch(parts.rummager))
        with Progress(NAME, settings.steps) as progress:
            outcome = run_fused(parts, options.seed, both(recorder, *([] if log is None else [log]), progress))
        parts.task.close()
        recorder.finish(outcome.found)
        if log is not None:
            log.finish(outcome.found)
    write_json(folder / "grasp.json", grasp_of(outcome))
    if options.figures and outcome.ended != "interrupted":
        say("drawing figures")
        draw_figures(folder, folder / "figures", None)
    sys.stdout.write(summary(outcome, folder, settings.budget_s))
    if outcome.ended == "interrupted":
        return INTERRUPTED
    return DONE if outcome.lifted else NOT_CONVERGED


def sensors_of(text: str) -> "tuple[SensorName, ...]":
    """The sensors that a text names, in their own order.

    Raises:
        UsageError: there is no such sensor.
    """
    from rumi.tasks.handle.settings import SENSORS

    if text == "all":
        return SENSORS
    named = text.split(",")
    for name in named:
        if name not in SENSORS:
            raise UsageError(f"There is no sensor {name!r}; there are all, {', '.join(SENSORS)}")
    return tuple(name for name in SENSORS if name in named)


def thinking_of(text: str) -> float | None:
    """Seconds that a decision lasts; None for as long as it takes.

    Raises:
        UsageError: it is neither a number of 0 or more nor "real".
    """
    if text == "real":
        return None
    try:
        seconds = float(text)
    except ValueError:
        seconds = -1.0
    if not (seconds >= 0 and math.isfinite(seconds)):
        raise UsageError(f"Expected --thinking to be seconds, 0 or more, or real, got {text!r}")
    return seconds


def grasp_of(outcome: "Outcome") -> dict[str, Any]:
    """What is told of a run beside its result: grasp, time, and the sum of nll."""
    names = ("ended", "lifted", "believed", "grasp", "total_nll", "total_s")
    found = outcome.as_dict()
    return {name: found[name] for name in names}


def short_of(settings: "FusedSettings") -> str | None:
    """What to say where the time is up before the first look's belief and the grasp are done; None where it is not."""
    from rumi.tasks.handle.gripper import GRASP_S

    least_s = (settings.thinking_s or 0.0) + GRASP_S
    if settings.budget_s >= least_s:
        return None
    return (
        f"a budget of {settings.budget_s:g} s is less than the {least_s:.1f} s that the first look's belief and the "
        "grasp take: it looks, grasps at once, and is late"
    )


def summary(outcome: "Outcome", folder: Path, budget_s: float) -> str:
    """A few lines on how a run ended."""
    from rumi.commands.run import ending

    found = outcome.found
    lines = ending(found, NAME)
    if outcome.ended == "budget":
        lines[0] = lines[0].replace("not sure", "out of time", 1)
    if outcome.grasp is not None:
        done = "lifted by its handle" if outcome.lifted else "not lifted"
        lines.append(f"grasp    {done}; believed {outcome.grasp.probability:.2f}")
    late_s = outcome.total_s - budget_s
    over = f", {late_s:.1f} too many" if late_s > 1e-6 else ""
    lines.append(f"clock    {outcome.total_s:.0f} s of {budget_s:g}{over}; nll summed up {outcome.total_nll:.0f}")
    lines.append(f"seconds  {sum(found.timings_s.values()):.1f}: {stages(found.timings_s)}")
    lines.append(f"folder   {folder}")
    return "\n  ".join(lines) + "\n"


def _log(folder: Path, seed: int, settings: "FusedSettings") -> "FusedLogRecorder":
    from rumi.runs.folder import provenance
    from rumi.runs.logbook import LOG
    from rumi.tasks.handle.log import FusedLogRecorder

    return FusedLogRecorder(folder / LOG, seed, settings, {"made_with": provenance()})
