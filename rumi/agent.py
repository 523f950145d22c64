"""The decision maker of a run: a belief, a rule to stop, a choice of actions, and a filter that takes in what came."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Generic, Literal, Protocol, Self, TypeVar, runtime_checkable

from rumi.clock import Clock
from rumi.task import Task

StopReason = Literal["sure", "steps", "budget", "nothing to do", "interrupted"]
"""Why a run ended: the belief is sure, the actions or the time are used up, no action is worth doing, or Ctrl-C."""

_FORMER = {"converged": "sure", "actions": "steps", "time": "nothing to do", "stay": "nothing to do"}


def stop_reason(recorded: str) -> str:
    """The reason that a record tells, in today's words; an experiment's own, such as "degenerate", as it is.

    >>> stop_reason("converged")
    'sure'
    """
    return _FORMER.get(recorded, recorded)


@runtime_checkable
class State(Protocol):
    """All that an agent knows after a reading, as a value: an update gives another one and leaves this as it is.

    Its random streams alone move on where they are drawn from.
    """

    @property
    def record(self) -> Any:  # noqa: ANN401  (of the task's own kind)
        """Of the last step; its `step` is the number of actions carried out so far, 0 at the first reading."""
        ...


S = TypeVar("S")


@runtime_checkable
class Agent(Protocol[S]):
    """Finds something out by acting; `rumi.loop.run` asks its methods in turn.

    It holds settings alone and may be used for many runs: what a run comes to know is in the state.
    """

    def begin(self, result: Any, *, seed: int, clock: Clock) -> S:  # noqa: ANN401  (what the task gives)
        """The state after the first reading.

        Args:
            result: of the task's `reset`.
            seed: of all randomness.
            clock: takes the time of each stage; it goes along in the state.
        """
        ...

    def stop(self, state: S) -> StopReason | None:
        """Why to stop now; None to go on."""
        ...

    def act(self, state: S) -> tuple[S, Any]:
        """The next action, None where none is worth doing, and the state with what was thought for it."""
        ...

    def update(self, state: S, action: Any, result: Any) -> S:  # noqa: ANN401
        """The state after an action and what came of it."""
        ...

    def last(self, state: S) -> Any:  # noqa: ANN401
        """What to do at the end, such as a grasp; None for nothing."""
        ...

    def result(self, state: S, stopped_by: StopReason, outcome: Any) -> Any:  # noqa: ANN401
        """How the run ended; `outcome` is what came of the last action, None where there was none."""
        ...


T = TypeVar("T", bound=Task)
A = TypeVar("A", bound=Agent[Any])


@dataclass(frozen=True)
class Parts(Generic[T, A]):
    """What a run needs beside its seed, in this order; a context manager that closes the task.

    Attributes:
        task: the simulator, the robot or the log.
        agent: what finds out.
    """

    task: T
    agent: A

    def __iter__(self) -> Iterator[Any]:
        yield from (self.task, self.agent)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.task.close()
