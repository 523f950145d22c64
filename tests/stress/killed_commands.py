"""SIGKILL at random moments of whole commands: what they had said stays, nothing half-written is believed.

A killed command ends as the undisturbed one up to there, bit for bit; given again where it goes on from what is kept,
it ends as if it had never been killed.
"""

import itertools
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from rumi.exit_codes import DONE, NOT_CONVERGED
from rumi.runs.folder import load_run
from tests.stress.killed_checks import arrays, check_run, check_same, results
from tests.stress.kills import Killed
from tests.stress.processes import Command, Commands

TASK = "mug-0"
QUICK = {
    "initialise.particles": "12",
    "initialise.starts": "40",
    "initialise.polished": "12",
    "planner.mppi.samples": "8",
    "planner.mppi.warmup-iterations": "1",
    "planner.rollouts": "1",
}
RUN = ["run", TASK, "--method", "slide", "--steps", "3", "--stop.rule", "never", "--no-figures"]
RUN += [text for name, value in QUICK.items() for text in (f"--{name}", value)]
SEEDS = 3
REPRODUCE = ["reproduce", "table6", "--tasks", TASK, "--methods", "rumi", "slide", "--presets", "default"]
REPRODUCE += ["--seeds", f"1000-{999 + SEEDS}", "--no-figures", "--set", "steps=2"]
REPRODUCE += [f"{name.replace('-', '_')}={value}" for name, value in QUICK.items()]
ORDER = ("run", "reproduce", "cache", "run", "reproduce")
"""The kinds by turn; caches take longest."""


@runtime_checkable
class Kind(Protocol):
    """A kind of command to kill."""

    def turn(self, random: np.random.Generator, number: int) -> int:
        """Start, kill and look; how many were killed.

        Raises:
            AssertionError: something was lost or believed wrongly.
        """
        ...

    def end(self) -> None:
        """Look at what is left after the last kill.

        Raises:
            AssertionError: it is not as if nothing had been killed.
        """
        ...


class RunKind:
    """`rumi run`.

    Args:
        commands: starts them.
        folder: to work in.
        cache: a folder of caches that holds the reach of the arm.

    Attributes:
        whole: the undisturbed run.
    """

    def __init__(self, commands: Commands, folder: Path, cache: Path) -> None:
        self._commands, self._folder, self._cache = commands, folder, cache
        if not any(cache.glob("reach-*.npz")):  # seconds that the others do not take
            self._begin("first").finish((NOT_CONVERGED,))
        self._seconds = self._begin("whole").finish((NOT_CONVERGED,))
        self.whole = load_run(folder / "whole")

    def _begin(self, name: str) -> Command:
        return self._commands.begin([*RUN, "--out", name], self._folder, name, cache=self._cache)

    def turn(self, random: np.random.Generator, number: int) -> int:
        """Kill a run and read its folder."""
        name = f"run-{number}"
        command = self._begin(name)
        if not command.kill_after(_moment(random, self._seconds)):
            return 0
        said = sum(line.startswith(("first view:", "action ")) for line in command.err.read_text().splitlines())
        run = self._folder / name
        check_run(run, said, self.whole)
        shutil.rmtree(run, ignore_errors=True)
        return 1

    def end(self) -> None:
        """Nothing is left: each run had a folder of its own."""


class CacheKind:
    """`rumi run` twice at once with one folder of caches that is empty, so that both solve the reach of the arm.

    Args:
        commands: starts them.
        folder: to work in.
    """

    def __init__(self, commands: Commands, folder: Path) -> None:
        self._commands, self._folder, self._cache = commands, folder, folder / "cache"
        self._seconds = self._begin("whole", folder / "whole-cache").finish((NOT_CONVERGED,))
        self._whole = {path.name: arrays(path) for path in (folder / "whole-cache").glob("*.npz")}
        self._run = load_run(folder / "whole")

    def _begin(self, name: str, cache: Path) -> Command:
        return self._commands.begin([*RUN, "--out", name], self._folder, name, cache=cache)

    def turn(self, random: np.random.Generator, number: int) -> int:
        """Kill both, then read what they kept, which is removed: the next ones work it out again."""
        both = [self._begin(f"run-{number}-{k}", self._cache) for k in range(2)]
        killed = sum(command.kill_after(_moment(random, self._seconds)) for command in both)
        self._check()
        for path in self._cache.glob("*.npz"):
            path.unlink()
        for k in range(2):
            shutil.rmtree(self._folder / f"run-{number}-{k}", ignore_errors=True)
        return killed

    def _check(self) -> None:
        for path in self._cache.glob("*.npz"):
            found, whole = arrays(path), self._whole.get(path.name, {})
            if found.keys() != whole.keys() or any(not np.array_equal(found[name], whole[name]) for name in whole):
                raise AssertionError(f"{path.name} is not what an undisturbed command keeps")

    def end(self) -> None:
        """A run with whatever is left in the folder of caches is as the undisturbed one."""
        self._begin("last", self._cache).finish((NOT_CONVERGED,))
        self._check()
        last = load_run(self._folder / "last")
        check_run(self._folder / "last", len(last.steps), self._run)
        if last.result is None:
            raise AssertionError("the last run has no result")


class ReproduceKind:
    """`rumi reproduce` twice at once on one file of results, again and again until all is there.

    Args:
        commands: starts them.
        folder: to work in.
        cache: a folder of caches that holds the reach of the arm.
    """

    def __init__(self, commands: Commands, folder: Path, cache: Path) -> None:
        self._commands, self._folder, self._cache, self._rounds = commands, folder, cache, 0
        whole = self._begin("whole", "whole")
        self._seconds = whole.finish((DONE,))
        self._table, self._whole = whole.out.read_text(), results(folder / "whole")

    def _begin(self, name: str, out: str) -> Command:
        return self._commands.begin([*REPRODUCE, "--out", out], self._folder, name, cache=self._cache)

    @property
    def _out(self) -> str:
        return f"killed-{self._rounds}"

    def turn(self, random: np.random.Generator, number: int) -> int:
        """Kill both; what was in the file stays, and what was added is right."""
        path = self._folder / self._out / "runs.jsonl"
        before = path.read_bytes() if path.exists() else b""
        both = [self._begin(f"command-{number}-{k}", self._out) for k in range(2)]
        killed = sum(command.kill_after(_moment(random, self._seconds)) for command in both)
        after = path.read_bytes() if path.exists() else b""
        if not after.startswith(before):
            raise AssertionError("what was in the file of results is not there any more")
        found = results(self._folder / self._out)
        check_same(found, {identity: self._whole.get(identity) for identity in found})
        if len(found) == len(self._whole):
            self.end()
            self._rounds += 1
        return killed

    def end(self) -> None:
        """Given once more, the command prints the table that an undisturbed one prints."""
        last = self._begin("last", self._out)
        last.finish((DONE,))
        check_same(results(self._folder / self._out), self._whole)
        if last.out.read_text() != self._table:
            raise AssertionError("the table is not that of an undisturbed command")


def kinds(commands: Commands, folder: Path) -> dict[str, Callable[[], Kind]]:
    """Makers of the kinds by name, each with a folder of its own; to make one carries out its command undisturbed."""
    cache = folder / "caches"
    made: dict[str, Callable[[], Kind]] = {
        "run": lambda: RunKind(commands, folder / "run", cache),
        "reproduce": lambda: ReproduceKind(commands, folder / "reproduce", cache),
        "cache": lambda: CacheKind(commands, folder / "cache"),
    }
    return made


def kill_commands(
    count: int,
    folder: Path,
    *,
    only: Sequence[str] = (),
    seed: int = 0,
    said: Callable[[int], None] | None = None,
) -> Killed:
    """Kill whole commands of each kind in turn; one that ended before its moment came counts for none.

    Args:
        count: how many kills, or one more where the last two came together; fewer after Ctrl-C.
        folder: to work in.
        only: kinds; all by default.
        seed: of the moments.
        said: called with the number of kills so far.

    Raises:
        AssertionError: an undisturbed command failed.
    """
    found = Killed()
    with Commands() as commands:
        makers = {name: make for name, make in kinds(commands, folder).items() if not only or name in only}
        chosen = {name: make() for name, make in makers.items()}
        turns = itertools.cycle(name for name in ORDER if name in chosen)
        random = np.random.default_rng(seed)
        try:
            for number, name in enumerate(turns):
                if sum(found.kills.values()) >= count:
                    break
                _turn(chosen[name], name, random, number, found)
                if said is not None:
                    said(sum(found.kills.values()))
        except KeyboardInterrupt:
            pass  # what was found is told
        for name in found.kills:
            try:
                chosen[name].end()
            except Exception as error:
                found.wrong.append(f"at the end, of {name}: {type(error).__name__}: {error}")
    return found


def _turn(kind: Kind, name: str, random: np.random.Generator, number: int, found: Killed) -> None:
    try:
        killed = kind.turn(random, number)
    except Exception as error:  # whatever is wrong is what is looked for
        killed = 1
        found.wrong.append(f"turn {number}, of {name}: {type(error).__name__}: {error}")
    found.kills[name] = found.kills.get(name, 0) + killed


def _moment(random: np.random.Generator, seconds: float) -> float:
    """Seconds of computing after which to kill."""
    return seconds * float(random.uniform(0.0, 1.0))
