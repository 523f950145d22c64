"""Pairs of `rumi run` at once: of two that want one folder one is refused; with default names each has its own.

A run that had its folder is bit for bit the undisturbed one of its seed, so that nothing is lost and nothing mixed.
"""

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rumi.exit_codes import BAD_INPUT, NOT_CONVERGED
from tests.stress.processes import Commands

RUN = ["run", "peg", "--most-actions", "2", "--particles", "150", "--search-particles", "400", "--no-figures"]
NAMED, DEFAULT = "one name", "default names"
TIMED = ("steps.jsonl", "result.json")
"""Files that hold seconds."""
_REFUSED = "holds a run already"
_APART_S = 0.2  # at most, between the two starts


@dataclass
class Paired:
    """What the pairs did.

    Attributes:
        pairs: how many of each kind.
        refused: runs that found their folder taken.
        wrong: what was lost or mixed, with the pair's number.
    """

    pairs: dict[str, int] = field(default_factory=dict)
    refused: int = 0
    wrong: list[str] = field(default_factory=list)


def run_pairs(
    count: int,
    folder: Path,
    *,
    cache: Path | None = None,
    seed: int = 0,
    said: Callable[[int], None] = lambda done: None,
) -> Paired:
    """Pairs, by turns with one `--out` and with none.

    Args:
        count: of pairs.
        folder: to work in.
        cache: folder that keeps the arm's reach; by default one in `folder`.
        seed: of how far apart the two start.
        said: told how many pairs are done.
    """
    random, found, cache = np.random.default_rng(seed), Paired(), cache or folder / "caches"
    with Commands() as commands:
        whole = []
        for number in (0, 1):
            commands.begin(_asked(number, "whole"), folder / f"{number}", "it", cache=cache).finish((NOT_CONVERGED,))
            whole.append(folder / f"{number}" / "whole")
        for turn in range(count):
            kind = (NAMED, DEFAULT)[turn % 2]
            found.pairs[kind] = found.pairs.get(kind, 0) + 1
            place = folder / f"pair-{turn}"
            pair = []
            for number in (0, 1):
                asked = _asked(number, "same") if kind == NAMED else _asked(0, None)
                pair.append(commands.begin(asked, place, f"{number}", cache=cache))
                if number == 0:
                    time.sleep(float(random.uniform(0.0, _APART_S)) * float(random.integers(2)))
            try:
                for command in pair:
                    command.finish((NOT_CONVERGED, BAD_INPUT) if kind == NAMED else (NOT_CONVERGED,))
                refused = [_REFUSED in command.err.read_text() for command in pair]
                found.refused += sum(refused)
                if kind == NAMED:
                    if sum(refused) != 1:
                        raise AssertionError(f"Expected one of two to be refused, got {refused}")
                    check_same(place / "same", whole[refused.index(False)])
                else:
                    made = sorted((place / "runs").iterdir())
                    if [path.name.endswith("-2") for path in made] != [False, True]:
                        raise AssertionError(f"Expected a folder each, got {[path.name for path in made]}")
                    for path in made:
                        check_same(path, whole[0])
            except AssertionError as error:
                found.wrong.append(f"pair {turn} of {kind}: {error}")
            shutil.rmtree(place, ignore_errors=True)
            said(turn + 1)
    return found


def check_same(run: Path, whole: Path) -> None:
    """Two folders hold the same files, and but for seconds the same bytes.

    Raises:
        AssertionError: they do not.
    """
    files, expected = ({path.name for path in folder.iterdir()} for folder in (run, whole))
    if files != expected:
        raise AssertionError(f"Expected {sorted(expected)} in {run}, got {sorted(files)}")
    for name in sorted(files - {*TIMED}):
        if (run / name).read_bytes() != (whole / name).read_bytes():
            raise AssertionError(f"{run / name} is not that of the undisturbed run")
    lines = [len((folder / "steps.jsonl").read_text().splitlines()) for folder in (run, whole)]
    if lines[0] != lines[1]:
        raise AssertionError(f"Expected {lines[1]} steps in {run}, got {lines[0]}")


def _asked(seed: int, out: str | None) -> list[str]:
    return [*RUN, "--seed", f"{seed}", *([] if out is None else ["--out", out])]
