"""The command `rumi stress`."""

import logging
import math
import sys
import tempfile
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from rumi.errors import UsageError
from rumi.exit_codes import DONE, INTERRUPTED
from rumi.runs.folder import write_json
from rumi.runs.jsonlines import check_writable
from rumi.runs.progress import say
from scripts.reproduce.intervals import wilson
from scripts.store import commit, machine
from sdf.extras import remedy
from tests.stress import exact, subjects
from tests.stress.sweep import SWEEPS, Outcome, Sweep, carry_out

if TYPE_CHECKING:
    from tests.stress.fuzz.run import Fuzzed

WRONG = 1
"""Exit code where an error exceeded its limit."""
KILLED = ("commands", "writers")
"""What `--kills` kills: whole commands, and processes that write one kind of file over and over."""
FAULTS = "faults"
"""What `--only` takes for runs with a fault."""
SLOW_FROM = 5.0
"""Minutes from which sweeps that take minutes are carried out too."""

_HELP = """Hold public operations to references of higher precision, over inputs at the edges of what can be.

    rumi stress --minutes 10 --json stress.json
    rumi stress --only se3-log-float32 fields --minutes 1
    rumi stress --only se3-log-float32 --seed 1234 --rounds 1 --show
    rumi stress --fuzz 100000
    rumi stress --kills 100
    rumi stress --pairs 200
    rumi stress --readings 10000
    rumi stress --only faults --rounds 20

Ends with exit code 1 if an error exceeds its limit or something comes out that is not finite, with 2 for bad input."""


@dataclass(frozen=True)
class StressOptions:
    """Options of `rumi stress`.

    Attributes:
        minutes: to spend; each sweep has one round at least. Those that take minutes run from 5 minutes on.
        only: sweeps, or the beginnings of their names; all if none is given. With --fuzz its targets, with --kills
            "commands" or "writers". "faults" alone: runs of a drawn mug with a drawn fault, each beside one without.
        seed: of the first round; by a worst case's seed it is drawn again.
        rounds: of each sweep, in place of minutes.
        json: file for what was found.
        show: print the inputs of the worst cases.
        list: name the sweeps, or with --fuzz its targets, and end.
        fuzz: instead of the sweeps, so many cases of functions, files, settings and command lines.
        kills: instead of the sweeps, kill whole commands so many times at random moments, and writers as often.
        pairs: instead of the sweeps, start so many pairs of runs at once that want one folder.
        readings: instead of the sweeps, follow one object over so many readings.
    """

    minutes: float = 1.0
    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    seed: int = 0
    rounds: int | None = None
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    show: bool = False
    list: bool = False
    fuzz: int | None = None
    kills: int | None = None
    pairs: int | None = None
    readings: int | None = None


def stress(arguments: Sequence[str]) -> int:
    """`rumi stress`: sweeps of public operations."""
    options = tyro.cli(
        StressOptions, prog="rumi stress", description=_HELP, args=arguments, config=(tyro.conf.FlagCreatePairsOff,)
    )
    if not (options.minutes > 0 and math.isfinite(options.minutes)):
        raise UsageError(f"Expected --minutes above 0, got {options.minutes}")
    if options.seed < 0 or (options.rounds is not None and options.rounds < 1):
        raise UsageError(f"Expected --seed from 0 and --rounds from 1, got {options.seed} and {options.rounds}")
    if options.json is not None:
        check_writable(options.json)
    instead = {name: getattr(options, name) for name in ("fuzz", "kills", "pairs", "readings")}
    asked = [name for name, count in instead.items() if count is not None]
    if len(asked) > 1 or any(count is not None and count < 1 for count in instead.values()):
        raise UsageError("Expected one of --fuzz, --kills, --pairs and --readings, with a number above 0")
    if asked:
        carried = {"fuzz": _fuzz, "kills": _kills, "pairs": _pairs, "readings": _readings}
        return int(carried[asked[0]](options, instead[asked[0]]))
    if options.only == (FAULTS,):
        return _faults(options)
    subjects.load()
    sweeps = _chosen(options)
    if options.list:
        sys.stdout.write("".join(f"{sweep.name}\n" for sweep in sweeps))
        return DONE
    if not exact.available():
        say(f"without mpmath some sweeps are left out: {remedy('stress')}")
    began = time.perf_counter()
    found, ended = sweep_all(sweeps, options), DONE
    if len(found) < len(sweeps):
        say(f"interrupted; {len(found)} of {len(sweeps)} sweeps were begun")
        ended = INTERRUPTED
    sys.stdout.write(table(list(found.values()), show=options.show))
    outcomes = [asdict(outcome) | {"kept": outcome.kept} for outcome in found.values()]
    _write(options, {"seconds": round(time.perf_counter() - began, 1), "outcomes": outcomes})
    return ended or (DONE if all(outcome.kept for outcome in found.values()) else WRONG)


def _fuzz(options: StressOptions, count: int) -> int:
    """Cases of all targets in turn, the same number of each."""
    from tests.stress.fuzz.run import fuzz
    from tests.stress.fuzz.targets import TARGETS

    chosen = {name: t for name, t in TARGETS.items() if not options.only or name.startswith(options.only)}
    if not chosen:
        raise UsageError(f"There is no target {options.only[0]!r}; the targets are {', '.join(TARGETS)}")
    if options.list:
        sys.stdout.write("".join(f"{name}\n" for name in chosen))
        return DONE
    logging.disable(logging.WARNING)  # damaged files are warned about, as they should be
    warnings.simplefilter("ignore")
    found: list[Fuzzed] = []
    each = -(-count // len(chosen))
    try:
        for name, one in chosen.items():
            _progress(len(found) + 1, len(chosen), name)
            found.append(fuzz(name, one, each, options.seed))
            _progress(0, 0, "")
            sys.stdout.write(_fuzzed(found[-1]))
            sys.stdout.flush()
    except KeyboardInterrupt:
        say("interrupted")
    finally:
        logging.disable(logging.NOTSET)
    wrong = sum(len(fuzzed.wrong) for fuzzed in found)
    cases = sum(fuzzed.cases for fuzzed in found)
    sys.stdout.write(f"{cases} cases of {len(found)} targets, {wrong} wrong\n")
    _write(options, {"fuzz": [asdict(fuzzed) for fuzzed in found]})
    return WRONG if wrong else INTERRUPTED if len(found) < len(chosen) else DONE


def _fuzzed(fuzzed: "Fuzzed") -> str:
    """A line on a target, and what was wrong."""
    bad = f", {len(fuzzed.wrong)} WRONG\n" if fuzzed.wrong else "\n"
    said = [f"    {what}\n" for what in fuzzed.wrong]
    return "".join([f"{fuzzed.name:<16} {fuzzed.cases:>7} cases, {fuzzed.refused:>7} refused", bad, *said])


def _kills(options: StressOptions, count: int) -> int:
    """Whole commands and writers killed at random moments."""
    from tests.stress.killed_commands import kill_commands
    from tests.stress.kills import Killed, kill_many

    if unknown := [name for name in options.only if name not in KILLED]:
        raise UsageError(f"There is nothing to kill called {unknown[0]!r}; there are {' and '.join(KILLED)}")
    found: dict[str, Killed] = {}
    for what in options.only or KILLED:
        with tempfile.TemporaryDirectory() as folder:
            kill = kill_commands if what == "commands" else kill_many
            said = partial(_progress, of=count, name=f"kills of {what}")
            found[what] = kill(count, Path(folder), seed=options.seed, said=said)
        _progress(0, 0, "")
        killed = found[what]
        told = ", ".join(f"{number} of {kind}" for kind, number in killed.kills.items())
        sys.stdout.write(f"{sum(killed.kills.values())} kills of {what} ({told}); {len(killed.wrong)} wrong\n")
        sys.stdout.write("".join(f"    {text}\n" for text in killed.wrong))
        sys.stdout.flush()
    _write(options, {what: asdict(killed) for what, killed in found.items()})
    return WRONG if any(killed.wrong for killed in found.values()) else DONE


def _pairs(options: StressOptions, count: int) -> int:
    """Pairs of runs at once."""
    from tests.stress.pairs import run_pairs

    with tempfile.TemporaryDirectory() as folder:
        found = run_pairs(count, Path(folder), seed=options.seed, said=partial(_progress, of=count, name="pairs"))
    _progress(0, 0, "")
    told = ", ".join(f"{number} with {kind}" for kind, number in found.pairs.items())
    sys.stdout.write(f"{count} pairs of runs ({told}); {found.refused} runs refused, {len(found.wrong)} pairs wrong\n")
    sys.stdout.write("".join(f"    {text}\n" for text in found.wrong))
    _write(options, asdict(found))
    return WRONG if found.wrong else DONE


def _faults(options: StressOptions) -> int:
    """Runs with a drawn fault, each beside the same run without, seed by seed."""
    from scripts import drawn_faults

    if options.list:
        sys.stdout.write(f"{FAULTS}\n")
        return DONE
    end, seed, ended = time.perf_counter() + 60.0 * options.minutes, options.seed, DONE
    lines: list[dict[str, Any]] = []
    try:
        while len(lines) < (options.rounds or math.inf):
            if lines and options.rounds is None and time.perf_counter() > end:
                break
            lines.append({"task": "mug", "conditions": "ideal", "seed": seed, **drawn_faults.measure("mug", seed)})
            seed += 1
            _progress(len(lines), options.rounds or 0, FAULTS)
    except KeyboardInterrupt:
        say("interrupted")
        ended = INTERRUPTED
    _progress(0, 0, "")
    sys.stdout.write(drawn_faults.show(lines, {}))
    wrong = [line for line in lines if drawn_faults.far(line["faulted"]) and not drawn_faults.flagged(line["faulted"])]
    alarmed = [line for line in lines if line["faultless"]["alarms"]]
    for told, some in (("far off, not flagged", wrong), ("false alarm", alarmed)):
        sys.stdout.write("".join(f"    {told}: seed {line['seed']}, {line['fault']}\n" for line in some))
    _write(options, {"runs": lines})
    # few runs say little of a rate: beyond its limit is what chance alone does not explain
    beyond = wilson(len(wrong), len(lines))[0] > 0.01 or wilson(len(alarmed), len(lines))[0] > 0.02
    return ended or (WRONG if lines and beyond else DONE)


def _readings(options: StressOptions, count: int) -> int:
    """One belief over many readings."""
    from tests.stress.long_run import long_run, text

    found = long_run(count, seed=options.seed, said=lambda done: _progress(done, count, "readings"))
    _progress(0, 0, "")
    sys.stdout.write(text(found))
    _write(options, asdict(found))
    return DONE


def _write(options: StressOptions, found: Mapping[str, Any]) -> None:
    if options.json is not None:
        about = {"commit": commit(), "machine": machine(), "seed": options.seed}
        write_json(options.json, {**about, **found})  # an infinite error becomes null, beside its failure


def sweep_all(sweeps: Sequence[Sweep], options: StressOptions) -> dict[str, Outcome]:
    """Rounds of the sweeps, each in turn that was given least time so far; what there is at an interrupt."""
    found: dict[str, Outcome] = {}
    end = time.perf_counter() + 60.0 * options.minutes
    try:
        for sweep in sweeps:
            count = options.rounds or 1
            found[sweep.name] = carry_out(sweep, range(options.seed, options.seed + count))
            _progress(len(found), len(sweeps), sweep.name)
        again = [sweep for sweep in sweeps if not sweep.slow]
        while options.rounds is None and again and time.perf_counter() < end:
            sweep = min(again, key=lambda one: found[one.name].seconds)
            before = found[sweep.name]
            found[sweep.name] = carry_out(sweep, (options.seed + before.rounds,), before)
    except KeyboardInterrupt:
        pass  # what was found is told
    finally:
        _progress(0, 0, "")
    return found


def table(found: Sequence[Outcome], *, show: bool = False) -> str:
    """The outcomes as a table: those that failed say how."""
    width = max((len(outcome.name) for outcome in found), default=4)
    lines = [f"{'sweep':<{width}}  {'cases':>8}  {'worst':>8}  {'limit':>8}  seed   condition"]
    for outcome in found:
        hard = "-" if outcome.condition is None else f"{outcome.condition:.3g}"
        lines.append(
            f"{outcome.name:<{width}}  {outcome.cases:>8}  {max(outcome.worst, 0.0):>8.1e}  {outcome.limit:>8.1e}  "
            f"{outcome.seed:<5}  {outcome.condition_of} {hard}" + ("" if outcome.kept else "   BEYOND ITS LIMIT")
        )
        if outcome.failure is not None:
            lines.append(f"    {outcome.failure}")
        if show or not outcome.kept:
            lines += [f"    case {outcome.case}: {name} = {text}" for name, text in outcome.inputs.items()]
    beyond = sum(not outcome.kept for outcome in found)
    cases = sum(outcome.cases for outcome in found)
    lines.append(f"{cases} cases in {len(found)} sweeps; {beyond} sweeps went beyond their limit")
    return "\n".join(lines) + "\n"


def _chosen(options: StressOptions) -> list[Sweep]:
    unknown = [name for name in options.only if not any(known.startswith(name) for known in SWEEPS)]
    if unknown:
        raise UsageError(f"There is no sweep {unknown[0]!r}; the sweeps are {', '.join(SWEEPS)}")
    wanted = [sweep for name, sweep in SWEEPS.items() if not options.only or name.startswith(options.only)]
    return [s for s in wanted if not s.slow or s.name in options.only or options.minutes >= SLOW_FROM or options.list]


def _progress(done: int, of: int, name: str) -> None:
    if sys.stderr.isatty():
        text = f"{done}/{of} {name}" if of else ""
        sys.stderr.write(f"\r{text:<70}" + ("" if of else "\r"))
        sys.stderr.flush()
