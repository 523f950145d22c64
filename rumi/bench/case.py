"""What is timed: a case is some work, its variants are ways to do it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor

from sdf import backend, compiled, gpu

By = Literal["rumi", "peer", "naive"]


@dataclass(frozen=True)
class Variant:
    """One way to do a case's work.

    Attributes:
        name: of the way.
        run: does it once and gives the result.
        by: whose: this project's, a public library's, or the straightforward way written down.
        version: backend that is forced meanwhile; None leaves the choice.
        share: of the whole work that `run` does, for ways that would take too long; times are scaled up.
        note: what else to know, a few words.
        comparable: whether the result is the same quantity as the reference.
    """

    name: str
    run: Callable[[], Any]
    by: By = "rumi"
    version: str | None = None
    share: float = 1.0
    note: str = ""
    comparable: bool = True

    def __call__(self) -> Any:  # noqa: ANN401  (whatever the work gives)
        """Do it once, with the version forced."""
        if self.version is None:
            return self.run()
        with backend.force(self.version):
            return self.run()


@dataclass(frozen=True)
class Case:
    """Some work and the ways to do it, on data made once.

    Attributes:
        title: one line for people.
        variants: the first one of this project's is what the results of the others are held against.
        items: how many equal things the work consists of.
        item: what they are called.
        baselines: ratios are taken against the quickest of these.
        otherwise: what they are taken against where none of these was timed.
        error: how far a result is from the reference's; None where no results can be compared.
        tolerance: by which all variants of this project must agree.
        reference: a result beyond doubt, where there is one; else that of the first variant.
        facts: what else was found, by name.
        remarks: what else to know.
        left_out: variants that are not there, and why.
        elsewhere: the work is done by other processes, whose time this one's processor clock does not see.
        rounds: at most, for work that takes seconds; None for as many as there is time for.
        warm: whether it is done a few times before anything counts.
    """

    title: str
    variants: tuple[Variant, ...]
    baselines: tuple[str, ...] = ()
    otherwise: str = "torch"
    items: int = 1
    item: str = "pass"
    error: Callable[[Any, Any], float] | None = None
    tolerance: float = 0.0
    reference: Any = None
    facts: dict[str, Any] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    elsewhere: bool = False
    rounds: int | None = None
    warm: bool = True


@dataclass(frozen=True)
class Setup:
    """What cases are made for.

    Attributes:
        device: where this project's variants run.
        tiny: make everything small, for tests.
        quick: do less of what takes long to prepare.
        cache_dir: folder that keeps what takes seconds to work out.
    """

    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    tiny: bool = False
    quick: bool = False
    cache_dir: Path | None = None

    def size(self, whole: int, tiny: int) -> int:
        """A size, by whether everything is to be small."""
        return tiny if self.tiny else whole

    @property
    def versions(self) -> tuple[str, ...]:
        """This project's versions to time on the device."""
        if self.device.type == "cuda" and gpu.available():
            return ("torch", gpu.VERSION)
        return ("torch", "numba") if self.device.type == "cpu" and compiled.available() else ("torch",)

    def ours(self, run: Callable[[], Any], what: str = "") -> tuple[Variant, ...]:
        """The versions of one way of this project's."""
        after = f", {what}" if what else ""
        return tuple(Variant(version + after, run, version=version) for version in self.versions)


CASES: dict[str, Callable[[Setup], Case]] = {}
"""All cases by name, in the order of the table."""

SLOW: set[str] = set()
"""Names of those that a quick run leaves out unless they are asked for."""


HOST: set[str] = set()
"""Names of those whose work is done on the CPU alone, whatever device the others run on."""

Make = TypeVar("Make", bound=Callable[..., Case])


def case(name: str, *, slow: bool = False, host: bool = False) -> Callable[[Make], Make]:
    """Decorator that enters a function as the maker of a case."""
    return cases({name: ()}, slow=slow, host=host)


def cases(named: Mapping[str, tuple[Any, ...]], *, slow: bool = False, host: bool = False) -> Callable[[Make], Make]:
    """Decorator that enters a function as the maker of several cases: what it takes beside the setup, by case."""

    def enter(make: Make) -> Make:
        for name, given in named.items():
            CASES[name] = partial(_made, make, given)
        SLOW.update(named if slow else ())
        HOST.update(named if host else ())
        return make

    return enter


def _made(make: Callable[..., Case], given: tuple[Any, ...], setup: Setup) -> Case:
    return make(setup, *given)


def largest_difference(found: Any, reference: Any) -> float:  # noqa: ANN401  (tensors, in tuples or alone)
    """Largest absolute difference of tensors, or of tuples of tensors; a shorter one is held against the start."""
    if isinstance(found, Tensor):
        return float((found.double() - reference[: len(found)].double()).abs().max()) if found.numel() else 0.0
    return max(largest_difference(a, b) for a, b in zip(found, reference, strict=True))
