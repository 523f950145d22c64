"""Accounts of skipped work: how much of each kind a scene did not need.

Whoever skips says so with `work`; who wants to know keeps an account with `account`. Without one nothing is counted.
"""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field

import torch
from torch import Tensor

from sdf.check import may_look


@dataclass
class Work:
    """One kind of work.

    Attributes:
        done: units that were done.
        whole: units that there would have been without skipping.
        seconds: that those done took, in all.
        pending: units done beside `done`, as single numbers on a GPU that the host has not waited for, and what each
            counts.
    """

    done: float = 0.0
    whole: float = 0.0
    seconds: float = 0.0
    pending: list[tuple[Tensor, float]] = field(default_factory=list)

    @property
    def skipped(self) -> float:
        """Share of the whole that was not done; 0 where there was nothing to do."""
        return 1.0 - self.done / self.whole if self.whole > 0 else 0.0

    @property
    def saved_s(self) -> float | None:
        """Seconds that the rest would have taken at the pace of what was done; None where nothing was done."""
        return self.seconds * (self.whole / self.done - 1.0) if self.done > 0 else None

    def count(self, done: float | Tensor, whole: float) -> None:
        """Say how much was done of how much; a tensor where it is not worth to wait for it now."""
        self._count(done, 1.0, whole)

    def count_share(self, share: float | Tensor, whole: float) -> None:
        """Say which share was done of how much."""
        self._count(share, whole, whole)

    def _count(self, number: float | Tensor, each: float, whole: float) -> None:
        if isinstance(number, Tensor) and not may_look(number):
            self.pending.append((number, each))
        else:
            self.done += float(number) * each
        self.whole += whole

    def add(self, other: "Work") -> None:
        """Add another's numbers."""
        self.count(other.done, other.whole)
        self.seconds += other.seconds
        self.pending += other.pending


@dataclass
class Account:
    """Work by name, in the order in which it was first met."""

    works: dict[str, Work] = field(default_factory=dict)

    def add(self, name: str, work: Work) -> None:
        """Add to the work of a name."""
        self.works.setdefault(name, Work()).add(work)

    def pending(self) -> list[Tensor]:
        """Numbers that the host has not waited for, in the order in which `settle` takes them."""
        return [number for work in self.works.values() for number, _ in work.pending]

    def settle(self, numbers: Sequence[float]) -> None:
        """Count what was pending, by numbers that have been fetched."""
        left = iter(numbers)
        for work in self.works.values():
            for _, each in work.pending:
                work.done += next(left) * each
            work.pending.clear()

    def skipped(self) -> dict[str, float]:
        """Share that was skipped, by name, without what is pending."""
        return {name: work.skipped for name, work in self.works.items()}


_kept: ContextVar[Account | None] = ContextVar("account", default=None)


@contextmanager
def account() -> Iterator[Account]:
    """Keep an account of the work within the block; one about it counts it too."""
    outer, own = _kept.get(), Account()
    token = _kept.set(own)
    try:
        yield own
    finally:
        _kept.reset(token)
        if outer is not None:
            for name, work in own.works.items():
                outer.add(name, work)


def kept() -> bool:
    """Whether an account is kept, so that counting is worth its time."""
    return not torch.compiler.is_compiling() and _kept.get() is not None


@contextmanager
def work(name: str, *, alike: bool = True) -> Iterator[Work]:
    """The work of the block: it says by `count` how much it did, and its time is taken.

    Args:
        name: what kind of work.
        alike: whether the units that are skipped would take as long as those done; if not, no time is kept.
    """
    own = Work()
    if torch.compiler.is_compiling():
        yield own
        return
    start = time.perf_counter()
    yield own
    own.seconds = (time.perf_counter() - start) * alike
    keeper = _kept.get()
    if keeper is not None and own.whole > 0:
        keeper.add(name, own)
