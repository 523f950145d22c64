"""How closed loops end: the figures of a run, which runs are right or wrong, and pairs of runs of the same seed."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from rumi import loop
from rumi.agent import Parts
from rumi.errors import DegenerateBeliefError
from rumi.tasks.rummage.settings import Settings
from scripts.reproduce.intervals import mcnemar
from scripts.store import Figures

_NAMES = {"lost": "lost", "mm": "position_error_mm", "deg": "rotation_error_deg"}
Runs = Mapping[int, Mapping[str, Any]]
"""Lines by seed."""


def unmeasured(settings: Settings) -> Settings:
    """The settings where nothing measures the object's motion."""
    return replace(settings, simulator=replace(settings.simulator, measures_motion=False))


def by_chance(settings: Settings) -> Settings:
    """The same, stopped by the belief's own probability of being right."""
    return replace(unmeasured(settings), stop=replace(settings.stop, rule="probability"))


def ended(
    parts: Parts[Any, Any], seed: int, on_step: Callable[[Any], None] = lambda step: None, more: Sequence[str] = ()
) -> Figures:
    """Figures of a run: why it stopped, whether it is right or lost, how far off; a belief that degenerates is lost.

    Args:
        parts: task and agent.
        seed: of the run.
        on_step: called with each step.
        more: further figures of the result.
    """
    names = _NAMES | {name: name for name in more}
    try:
        result = loop.run_to_end(*parts, seed=seed, on_step=on_step)
    except DegenerateBeliefError:
        return dict.fromkeys(names) | {"stopped_by": "degenerate", "right": False, "lost": True}
    found = {"stopped_by": result.stopped_by, "right": result.right}
    return found | {name: getattr(result, own) for name, own in names.items()}


def sure(run: Mapping[str, Any]) -> bool:
    """Whether a run ended sure, and nothing spoke for a fault."""
    return run["stopped_by"] == "sure" and not run["lost"]


def right(run: Mapping[str, Any]) -> bool:
    """Whether a run ended sure, not lost, and right."""
    return sure(run) and bool(run["right"])


def wrong(run: Mapping[str, Any]) -> bool:
    """Whether a run ended sure, not lost, and not right."""
    return sure(run) and not run["right"]


def won_lost(runs: Runs, others: Runs, good: Callable[[Mapping[str, Any]], bool] = right) -> str:
    """Runs that are good where others of the same seed are not, and the other way round, with McNemar's p."""
    both = sorted(runs.keys() & others.keys())
    mine, other = ([good(one[seed]) for seed in both] for one in (runs, others))
    won = sum(a and not b for a, b in zip(mine, other, strict=True))
    lost = sum(b and not a for a, b in zip(mine, other, strict=True))
    return f"{won}; {lost} ({mcnemar(mine, other):.2g})"
