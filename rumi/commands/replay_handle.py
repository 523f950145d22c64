"""The command `rumi replay` of a log of the handle task."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from rumi.errors import UsageError
from rumi.exit_codes import DONE, NOT_CONVERGED
from rumi.runs.progress import Progress, both, say
from rumi.tasks.handle.settings import FusedSettings
from rumi.tasks.rummage.entry import describe

if TYPE_CHECKING:
    from sensors.log.reader import Log

_HELP = """Take in the log of a run of the handle task as if its robot were there: the belief that the live run had,
or, with other settings, the one that it would have had on the same readings.

    rumi replay runs/handle-all-s0
    rumi replay runs/handle-all-s0/log.h5 --wrist.outlier 0.3 --out what-if

The log's own settings are where the flags start from. What was done is recorded, so that budget and thinking change
nothing, and what decides what was sensed is refused. Nothing is grasped."""


@dataclass(frozen=True)
class FusedReplayOptions:
    """Options of `rumi replay`.

    Attributes:
        log: the log, or the run's folder that it lies in.
        settings: of the replay.
        seed: of the belief's randomness.
        out: folder for the replayed run, for `rumi plot`; none is written without.
        figures: draw its figures.
    """

    log: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")]
    settings: Annotated[FusedSettings, tyro.conf.arg(name="")]
    seed: int
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    figures: bool = False


def replay_handle(log: "Log", arguments: Sequence[str], cache_dir: Path | None) -> int:
    """`rumi replay` of such a log: 0 if the belief became sure, 1 if not or if it is not the recorded one."""
    from rumi.commands.replay import machines, summary
    from rumi.runs.folder import RunRecorder, load_run, prepare_folder
    from rumi.runs.replay import replay
    from rumi.tasks.handle.agent import build_agent
    from rumi.tasks.handle.log import IDLE, asked_of, differing, recorded, refuse_other_senses
    from rumi.tasks.rummage.build import scene_sketch
    from sensors.contact_reading import ContactReading

    known = recorded(log)
    if known is None:
        raise UsageError(f"Expected the log of a run of the handle task, got {log.path}")
    seed, before = known
    start = FusedReplayOptions(log.path, before, seed)
    options = tyro.cli(FusedReplayOptions, prog="rumi replay", description=_HELP, args=arguments, default=start)
    settings = options.settings
    refuse_other_senses(before, settings)
    if options.seed < 0:
        raise UsageError(f"Expected seed to be 0 or more, got {options.seed}")
    changed = differing(before, settings) + (["seed"] if options.seed != seed else [])
    if idle := [name for name in changed if name in IDLE]:
        say(f"{', '.join(idle)}: no effect, since what was done is recorded")
    agent = build_agent(settings, cache_dir=cache_dir)
    if options.out is not None:
        prepare_folder(options.out)
    elif options.figures:
        raise UsageError("Expected --out DIR with --figures, got none: figures need a folder")
    taken = log.taken(ContactReading)[: settings.steps + 1]
    for problem in log.problems:
        say(problem)
    with Progress("handle", len(taken) - 1, describe) as progress:
        if options.out is None:
            done = replay(taken, agent, seed=options.seed, on_step=progress)
        else:
            asked = asked_of(options.seed, settings)
            with RunRecorder(options.out, asked) as recorder:
                recorder.scene(scene_sketch(agent.rummager))
                done = replay(taken, agent, seed=options.seed, on_step=both(recorder, progress))
                recorder.finish(done.result)
    if options.figures and options.out is not None:
        from rumi.viz.figures import make_figures

        make_figures(load_run(options.out), options.out / "figures", None)
    mattering = [name for name in changed if name not in idle]
    sys.stdout.write(summary(done, len(taken), mattering, options.out, "handle", go_on=""))
    if not mattering and False in done.same:
        for line in machines(log):
            say(line)
        return NOT_CONVERGED
    return DONE if done.result.stopped_by == "sure" else NOT_CONVERGED
