"""Cases of the targets by seed: what comes out undocumented, and by which seed it comes again."""

import contextlib
import pickle
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from tests.stress.fuzz.draw import Draw, Seeded
from tests.stress.fuzz.entered import DOCUMENTED

Target = Callable[[Draw], Iterable[Tensor]]


class PickleLoadedError(Exception):
    """Something was about to be unpickled: a file could have run code."""


@dataclass
class Fuzzed:
    """What the cases of a target did.

    Attributes:
        name: of the target.
        cases: carried out.
        refused: of which ended in a documented error.
        wrong: seeds of those that did not keep to what is documented, with what they did.
    """

    name: str
    cases: int = 0
    refused: int = 0
    wrong: list[tuple[str, str]] = field(default_factory=list)


def one(target: Target, draw: Draw, documented: tuple[type[BaseException], ...] = DOCUMENTED) -> bool:
    """A case; whether it was refused with a documented error.

    Raises:
        AssertionError: numbers that are not finite came out of finite ones.
        PickleLoadedError: something was unpickled.
        Exception: anything that is not documented.
    """
    with no_pickles():
        try:
            for result in target(draw):
                if not bool(torch.isfinite(result).all()):
                    raise AssertionError(f"numbers that are not finite came out, of shape {tuple(result.shape)}")
        except documented:
            return True
    return False


def many(
    name: str, target: Target, seeds: Iterable[str], documented: tuple[type[BaseException], ...] = DOCUMENTED
) -> Fuzzed:
    """Cases of a target, one a seed."""
    found = Fuzzed(name)
    for seed in seeds:
        found.cases += 1
        try:
            found.refused += one(target, Seeded(f"{name}/{seed}"), documented)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # whatever comes out is what is looked for
            frame = traceback.extract_tb(error.__traceback__)[-1]
            said = f"{type(error).__name__}: {error} ({frame.name}, line {frame.lineno})"
            found.wrong.append((seed, said[:300]))
    return found


def _asked_by(package: str) -> bool:
    """Whether one of the callers nearest to pickle is of a package."""
    frame = sys._getframe(2)
    for _ in range(8):
        if str(frame.f_globals.get("__name__")).startswith(package):
            return True
        if frame.f_back is None:
            return False
        frame = frame.f_back
    return False


@contextlib.contextmanager
def no_pickles() -> Iterator[None]:
    """Within the block, unpickling raises `PickleLoadedError`, however it is asked for; but for numba's own."""
    before: Mapping[str, Any] = {name: getattr(pickle, name) for name in ("load", "loads", "Unpickler")}

    def guarded(name: str) -> Callable[..., Any]:
        def refuse(*args: Any, **kwargs: Any) -> Any:  # noqa: ANN401  (whatever pickle's takes and gives)
            # numba keeps what it compiled of our own code so, beside that code
            if _asked_by("numba."):
                return before[name](*args, **kwargs)
            raise PickleLoadedError("a pickle was about to be loaded")

        return refuse

    try:
        for name in before:
            setattr(pickle, name, guarded(name))
        yield
    finally:
        for name, function in before.items():
            setattr(pickle, name, function)
