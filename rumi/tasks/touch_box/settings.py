"""Settings of finding a box by touch alone."""

from dataclasses import dataclass, field
from typing import Annotated

from annotated_types import Ge

from rumi.belief.trajectory_filter import TrajectorySettings
from rumi.dynamics.registry import PUSH_MODELS
from rumi.errors import UsageError
from rumi.tasks.touch_box.selection import METHODS
from sdf.bounds import Checked, Count, CountOr0, Finite, NotNegative, OneOf, Positive, ShareAbove0


@dataclass(frozen=True)
class PokeSettings(Checked, refusal=UsageError):
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

    candidates: Count = 20
    particles: Count = 100
    bend: NotNegative = 0.1
    hold_m: NotNegative = 0.015
    sure: ShareAbove0 = 0.8
    samples: Count = 32
    every: Count = 4
    neighbours: Annotated[int, Ge(2)] = 5
    funnel: Finite = 0.0


def _filter() -> TrajectorySettings:
    return TrajectorySettings(
        trigger=0.5,
        sweeps=6,
        friction=(0.1, 0.7),
        # c of even pressure is 0.0447: real objects have 0.4 to 1.6 of it, what stands on its four corners 2.45
        lever_m=(0.4 * 0.0447, 2.45 * 0.0447),
        noise=0.08,
        noise_tails=0.1,
    )


@dataclass(frozen=True)
class TouchSettings(Checked, refusal=UsageError):
    """All that decides a run but the task.

    Attributes:
        method: by which pokes are chosen: "sequence" is the information of all readings until the belief expects
            contact to have lasted; "entropy" the paper's Eq 9, one reading at the best step; "weights-only" that
            without the density term; "ml-observation" lets the likeliest particle alone say what is read;
            "max-contact" counts particles that are touched; "uninformed" draws; or a name that an installed package
            adds.
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

    method: Annotated[str, OneOf(METHODS)] = "sequence"
    push_model: Annotated[str, OneOf(PUSH_MODELS)] = "quasi-static"
    count: Count = 800
    threshold: ShareAbove0 = 0.92
    actions: CountOr0 = 15
    decay: Positive | None = 1000.0
    weigh_correlated: bool = True
    stop_early: bool = True
    filter: TrajectorySettings = field(default_factory=_filter)
    poke: PokeSettings = field(default_factory=PokeSettings)
