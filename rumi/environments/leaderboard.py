"""Leader board of policies: whole runs over given seeds, each by `rumi.loop.run_to_end`."""

import hashlib
import importlib.util
import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Any, Protocol, cast, runtime_checkable

import torch
from torch import Tensor

from rumi.environments.views import VIEWS, Observed, View
from rumi.errors import UsageError
from rumi.loop import run_to_end
from rumi.task import StepResult, Task
from rumi.tasks.rummage.agent import Rummager, RummageState

OWN = "rumi"
"""The policy that plans as `rumi run` does."""


@runtime_checkable
class Policy(Protocol):
    """What a policy's file defines: a function `act`; `VIEW` names what it sees, "particles" by default.

    Where it defines `start(seed)` too, that is called before each run.
    """

    def act(self, observation: Observed) -> Any:  # noqa: ANN401  (an array, a list or a tensor)
        """The control, each number in [-1, 1]."""
        ...


@dataclass(frozen=True)
class Score:
    """How a policy did on a task.

    Attributes:
        policy: its file's name.
        digest: of the file; "" of the own planner.
        task: by name.
        preset: of the settings.
        seeds: of the runs.
        right: runs whose last belief was right.
        wrong: runs that were sure and wrong.
        actions: median of the actions until a run ended.
        decision_ms: mean CPU time of a decision.
    """

    policy: str
    digest: str
    task: str
    preset: str
    seeds: list[int]
    right: int
    wrong: int
    actions: float
    decision_ms: float

    def line(self) -> dict[str, Any]:
        """As JSON has it."""
        return asdict(self)


@dataclass(frozen=True)
class Player:
    """An agent whose decisions are timed, and a policy's where one is given; all else is the agent's.

    Attributes:
        agent: that believes, and plans where there is no policy.
        policy: that chooses.
        view: what it sees.
        taken: CPU seconds of each decision.
    """

    agent: Rummager
    policy: Policy | None = None
    view: View | None = None
    taken: list[float] = field(default_factory=list)

    def act(self, state: RummageState) -> tuple[RummageState, Tensor]:
        """The planner's control, or the policy's."""
        seen = None if self.view is None else self.view(StepResult(state.record.reading), state)
        start = time.process_time()
        if self.policy is None or seen is None:
            decided = self.agent.act(state)
            self.taken.append(time.process_time() - start)
            return decided
        with blamed(getattr(self.policy, "__file__", "the policy")):
            control = torch.as_tensor(self.policy.act(seen), dtype=torch.float32).detach().cpu()
        self.taken.append(time.process_time() - start)
        size = len(self.agent.tool.scale)
        if tuple(control.shape) != (size,) or not bool(torch.isfinite(control).all()):
            raise UsageError(f"Expected act to give {size} finite numbers, got {control.tolist()}")
        return state, control.clamp(-1.0, 1.0)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  (the rest is the agent's)
        return getattr(self.agent, name)


@contextmanager
def blamed(file: Path | str) -> Iterator[None]:
    """A policy's own error as one of usage, that names its file, the kind of the error and what it says."""
    try:
        yield
    except Exception as error:  # whatever people write
        raise UsageError(
            f"Expected {file} to define act(observation), which gives a control of numbers, got "
            f"{type(error).__name__}: {error} (RUMI_DEBUG=1 shows where this comes from)"
        ) from error


def load_policy(path: Path) -> tuple[Policy, str]:
    """The policy that a file defines, and the name of its view.

    Raises:
        UsageError: there is no such file, it cannot be loaded, or it defines no `act`.
    """
    spec = importlib.util.spec_from_file_location(path.stem, path) if path.is_file() else None
    if spec is None or spec.loader is None:
        raise UsageError(f"Expected a Python file that defines act(observation), or {OWN!r}, got {path}")
    module = importlib.util.module_from_spec(spec)
    with blamed(path):
        spec.loader.exec_module(module)
    if not callable(getattr(module, "act", None)):
        raise UsageError(f"Expected {path} to define a function act(observation), which gives the control")
    view = getattr(module, "VIEW", "particles")
    if view not in VIEWS:
        raise UsageError(f"There is no view {view!r}; the views are {', '.join(VIEWS)}")
    return cast(Policy, module), view


def score(
    task: Task,
    agent: Rummager,
    path: Path | None,
    *,
    name: str,
    preset: str,
    instants: int,
    seeds: Sequence[int],
    on_run: Callable[[int, Any], None] = lambda seed, result: None,
) -> Score:
    """Carry out a run of each seed.

    Args:
        task: the simulator.
        agent: that believes.
        path: of the policy's file; None for the agent's own planner.
        name: of the task.
        preset: of the settings.
        instants: of a reading.
        seeds: of the runs.
        on_run: called with a run's seed and result.

    Raises:
        UsageError: the file is no policy.
        KeyboardInterrupt: Ctrl-C cut a run off.
    """
    player: Any = Player(agent)
    if path is not None:
        policy, view = load_policy(path)
        player = Player(agent, policy, VIEWS[view](agent, instants))
    results = []
    for seed in seeds:
        if path is not None and hasattr(player.policy, "start"):
            with blamed(path):
                player.policy.start(seed)
        result = run_to_end(task, player, seed=seed, steps=agent.steps)
        results.append(result)
        on_run(seed, result)
    return Score(
        OWN if path is None else path.name,
        "" if path is None else hashlib.sha256(path.read_bytes()).hexdigest()[:12],
        name,
        preset,
        list(seeds),
        right=sum(bool(result.right) for result in results),
        wrong=sum(result.stopped_by == "sure" and not result.right for result in results),
        actions=float(median(result.steps for result in results)),
        decision_ms=1e3 * sum(player.taken) / max(1, len(player.taken)),
    )


def read_board(path: Path) -> list[Score]:
    """Scores that a board's file holds, a line each; none where there is no file.

    Raises:
        UsageError: a line is none.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
        return [Score(**json.loads(line)) for line in lines]
    except (ValueError, TypeError) as error:
        raise UsageError(f"Expected {path} to hold a score a line, got another: {error}") from error


def table(scores: Sequence[Score]) -> str:
    """The scores of a task, best first: by how many were right, then how few sure and wrong, then few actions."""
    rows = [("policy", "right", "sure and wrong", "actions", "ms a decision")]
    order = sorted(scores, key=lambda one: (-one.right / len(one.seeds), one.wrong / len(one.seeds), one.actions))
    for one in order:
        count = len(one.seeds)
        shown = f"{one.policy} {one.digest}".strip()
        rows.append((shown, f"{one.right} of {count}", str(one.wrong), f"{one.actions:g}", f"{one.decision_ms:.1f}"))
    widths = [max(len(row[k]) for row in rows) for k in range(5)]
    lines = ("  ".join(f"{part:<{width}}" for part, width in zip(row, widths, strict=True)) for row in rows)
    return "".join(f"{line.rstrip()}\n" for line in lines)
