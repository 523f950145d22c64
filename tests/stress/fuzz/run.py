"""Cases of the targets by hypothesis: what comes out undocumented, made as small as can be."""

import contextlib
import pickle
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import hypothesis
import torch
from hypothesis import strategies as st
from torch import Tensor

from tests.stress.fuzz.draw import Draw
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
        wrong: what the smallest case did that did not keep to what is documented.
    """

    name: str
    cases: int = 0
    refused: int = 0
    wrong: list[str] = field(default_factory=list)


def one(target: Target, draw: Draw) -> bool:
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
        except DOCUMENTED:
            return True
    return False


def fuzz(name: str, target: Target, cases: int, seed: int = 0) -> Fuzzed:
    """So many cases of a target as hypothesis draws them; where one is wrong, the smallest that is."""
    found = Fuzzed(name)

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=cases,
        deadline=None,
        database=None,
        report_multiple_bugs=False,
        suppress_health_check=list(hypothesis.HealthCheck),
        phases=(hypothesis.Phase.generate, hypothesis.Phase.shrink),
    )
    @hypothesis.given(data=st.data())
    def case(data: st.DataObject) -> None:
        found.cases += 1
        found.refused += one(target, Draw(data))

    try:
        case()
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # whatever comes out is what is looked for
        frame = traceback.extract_tb(error.__traceback__)[-1]
        found.wrong.append(f"{type(error).__name__}: {error} ({frame.name}, line {frame.lineno})"[:300])
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
