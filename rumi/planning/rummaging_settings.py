"""Settings of RUMI's policy."""

from dataclasses import dataclass, field
from typing import Self

from kmppi import MPPISettings
from rumi.dynamics.base import PushDefaults
from rumi.dynamics.displacement_rollouts import DisplacementSettings
from rumi.dynamics.registry import PUSH_MODELS, PushSettings
from rumi.fields.information import InformationSettings
from rumi.planning.next_touch import NextTouchSettings
from sdf.bounds import Count, NotNegative, Share, ShareAbove0


def _scale_free() -> MPPISettings:
    # near the arg-min of the samples: a warmer mean of plans that go round either side of the object stands still
    return MPPISettings(temperature=0.03, cost_scale="std", iterations=2)


@dataclass(frozen=True)
class RummagingSettings(PushSettings):
    """Settings of the policy, beside the `PushSettings`.

    The defaults do not depend on the unit of the information; `paper()` has the paper's.

    Attributes:
        next_touch: choose the next touch by the belief's first contacts (`NextTouchPolicy`) in the place of all that
            follows. None for where actions in space are guarded and no push model is asked for.
        touches: of that choice.
        information: the field that is to be gathered.
        mppi: the planner; its iterations are `warmup_iterations` for the first plan.
        information_scale: weight of the information cost (beta_I); 0 leaves it out.
        reachability_scale: weight of the reachability cost (beta_R); 0 leaves it out. None for what suits the push
            model, its `defaults`.
        push_scale: weight of the way that the object is pushed, against all the information, for each metre: what a
            push costs in certainty where nothing measures it. An action's is worth less the later it is, as information
            is. None for 1 where actions in space are guarded, else 0.
        sensed_here: leave out the information where the tool senses now, which it has: held up by the object, it would
            gather it again and again. None for where actions in space are guarded.
        least_share: of the information, what a plan has to gather: else reach is what keeps it from the object, and
            it is made anew with a quarter of the weight on reach, up to three times. 0 takes any plan. None for what
            suits the push model, its `defaults`. Plans with a budget are made once.
        information_discount: factor by which information is worth less with each action until it is gathered. At 1,
            the paper's, a plan may put its touches off to the end of the horizon, and so may the next plan.
        normalise_information: count information as a share of all there is, so that both costs are in [-1, 0].
        displaced_information: count information where the object will have been moved to (Eq 29); False is the ablation
            that counts it where it is now (Eq 28).
        rollouts: how often each control sequence is rolled out; its cost is the mean. None for as many as suit the
            push model, its `defaults`.
        screen_rollouts: by how many coarse rollouts all control sequences are told apart first.
        screen_kept: share of them, those of the least cost, that is rolled out in full after that, 16 at least; the
            others keep their coarse cost, which is too high to weigh. 1 rolls out all in full, and nothing before.
    """

    next_touch: bool | None = None
    touches: NextTouchSettings = field(default_factory=NextTouchSettings)
    information: InformationSettings = field(default_factory=InformationSettings)
    mppi: MPPISettings = field(default_factory=_scale_free)
    information_scale: NotNegative = 1.0
    reachability_scale: NotNegative | None = None
    push_scale: NotNegative | None = None
    sensed_here: bool | None = None
    least_share: Share | None = None
    information_discount: ShareAbove0 = 0.9
    normalise_information: bool = True
    displaced_information: bool = True
    rollouts: Count | None = None
    screen_rollouts: Count = 2
    screen_kept: ShareAbove0 = 0.125

    def __post_init__(self) -> None:
        """Refuse what gives nothing to plan for."""
        super().__post_init__()
        if self.information_scale == 0 and self.reachability_scale == 0:
            raise ValueError("Expected information_scale and reachability_scale not both 0")

    def suited(self, push_model: str) -> PushDefaults:
        """What is set, or else suits a push model other than "auto"."""
        best, reach, rollouts = PUSH_MODELS[push_model].defaults, self.reachability_scale, self.rollouts
        return PushDefaults(
            best.reachability_scale if reach is None else reach,
            best.rollouts if rollouts is None else rollouts,
            best.least_share if self.least_share is None else self.least_share,
        )

    @classmethod
    def paper(cls) -> Self:
        """The paper's settings (Table IV)."""
        return cls(
            information=InformationSettings(mode="surrogate"),
            push_model="displacement",
            push=DisplacementSettings(hazard="per_mini_step"),
            mppi=MPPISettings(temperature=0.01, cost_scale="raw"),
            reachability_scale=200.0,
            rollouts=5,
            screen_kept=1.0,
            least_share=0.0,
            information_discount=1.0,
            normalise_information=False,
        )
