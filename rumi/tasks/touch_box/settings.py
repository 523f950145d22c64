"""Settings of finding a box by touch alone."""

import math
from dataclasses import dataclass, field

from rumi.belief.trajectory_filter import TrajectorySettings
from rumi.dynamics.registry import PUSH_MODELS
from rumi.errors import UsageError
from rumi.tasks.touch_box.selection import METHODS, Method


@dataclass(frozen=True)
class PokeSettings:
    """Candidates and their choice.

    Attributes:
        candidates: pokes that are weighed.
        particles: of the belief, over which they are rolled out.
        bend: standard deviation of a via-point aside, as a share of a poke's length.
        hold_m: way in contact after which a poke has told what it can: it ends where the belief expects as much.
        sure: share of the belief that must expect so.
        samples: reading sequences that are drawn a candidate.
        every: steps from one density term to the next.
        neighbours: rho of the density term.
        funnel: nats of worth for each nat by which motion alone shrinks the belief.
    """

    candidates: int = 20
    particles: int = 100
    bend: float = 0.1
    hold_m: float = 0.015
    sure: float = 0.8
    samples: int = 32
    every: int = 4
    neighbours: int = 5
    funnel: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what has no meaning."""
        for name in ("candidates", "particles", "samples", "every"):
            if getattr(self, name) < 1:
                raise UsageError(f"Expected {name} to be 1 or more, got {getattr(self, name)}")
        if self.neighbours < 2:
            raise UsageError(f"Expected neighbours to be 2 or more, got {self.neighbours}")
        for name in ("bend", "hold_m"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise UsageError(f"Expected {name} to be 0 or more, got {getattr(self, name)}")
        if not math.isfinite(self.funnel):
            raise UsageError(f"Expected funnel to be a finite number of nats, got {self.funnel}")
        if not 0.0 < self.sure <= 1.0:
            raise UsageError(f"Expected sure in (0, 1], got {self.sure}")


def _filter() -> TrajectorySettings:
    return TrajectorySettings(
        trigger=0.5,
        sweeps=6,
        friction=(0.1, 0.7),
        # square roots of 1.5 to 6: c of even pressure up to that of the four corners
        lever_m=(1.22 * 0.0447, 2.45 * 0.0447),
        noise=0.08,
        noise_tails=0.1,
    )


@dataclass(frozen=True)
class TouchSettings:
    """All that decides a run but the task.

    Attributes:
        method: by which pokes are chosen.
        push_model: by which particles are moved.
        count: particles.
        threshold: believed chance of lifting at which the box is grasped.
        actions: pokes at most; then it is grasped all the same.
        decay: fall-off of a contact signal with distance, 1/m; None for a signal that knows only touching (up to the
            0.2 mm at which simulated readings do) and not touching.
        weigh_correlated: count readings that repeat their errors with a chance c as (1 - c) / (1 + c) of independent
            ones each: so much less do they tell of what they are a mean of.
        stop_early: end a poke where the belief expects contact to have lasted; off: push through.
        filter: of the particles; its ranges of friction and limit surface are those for the default task, and go with
            another's as `rumi.tasks.touch_box.agent.for_task` has it.
        poke: candidates and their choice.
    """

    method: Method = "sequence"
    push_model: str = "quasi-static"
    count: int = 800
    threshold: float = 0.92
    actions: int = 15
    decay: float | None = 1000.0
    weigh_correlated: bool = True
    stop_early: bool = True
    filter: TrajectorySettings = field(default_factory=_filter)
    poke: PokeSettings = field(default_factory=PokeSettings)

    def __post_init__(self) -> None:
        """Refuse what has no meaning."""
        if self.method not in METHODS:
            raise UsageError(f"Expected a method out of {', '.join(METHODS)}, got {self.method!r}")
        if self.push_model not in PUSH_MODELS:
            raise UsageError(f"Expected a push model out of {', '.join(PUSH_MODELS)}, got {self.push_model!r}")
        if self.count < 1 or self.actions < 0:
            raise UsageError(f"Expected count >= 1 and actions >= 0, got {self.count} and {self.actions}")
        if not 0.0 < self.threshold <= 1.0:
            raise UsageError(f"Expected threshold in (0, 1], got {self.threshold}")
        if self.decay is not None and not 0.0 < self.decay < math.inf:
            raise UsageError(f"Expected decay above 0, or None for a step, got {self.decay}")
