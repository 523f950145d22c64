"""The fused run, top to bottom: look, then plan, act, sense, fuse, until sure or out of time; then grasp."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from rumi.clock import Clock
from rumi.planning.policy import Plan, Scene
from rumi.records import RunResult, StepRecord
from rumi.seeding import split
from rumi.tasks.handle.agent import begin, belief_streams, follow
from rumi.tasks.handle.build import FusedParts
from rumi.tasks.handle.grasp import Grasp, best_grasp
from rumi.tasks.handle.gripper import GRASP_S
from rumi.tasks.rummage.scoring import observe, summarise

Ended = Literal["sure", "steps", "budget", "interrupted"]

_LEAST_PLAN_S = 0.05


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    Attributes:
        found: what the belief came to, up to the grasp.
        ended: "sure", out of actions ("steps"), out of time ("budget"), or "interrupted".
        grasp: where the mug was grasped, and the believed chance of lifting it; None where the run was interrupted.
        lifted: whether it was.
        nll: (RUMI, Eq 36) after the first view and each action.
        total_nll: nll summed up over the first view and as many actions as the settings say; after the last action the
            belief stays as it is.
        total_s: on the run's clock, the grasp included.
    """

    found: RunResult
    ended: Ended
    grasp: Grasp | None
    lifted: bool
    nll: tuple[float, ...]
    total_nll: float
    total_s: float

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        grasp = None if self.grasp is None else self.grasp.pose.tolist()
        chance = None if self.grasp is None else self.grasp.probability
        own = {"ended": self.ended, "lifted": self.lifted, "believed": chance, "grasp": grasp}
        return {
            **own,
            "nll": list(self.nll),
            "total_nll": self.total_nll,
            "total_s": self.total_s,
            **asdict(self.found),
        }


def run_fused(parts: FusedParts, seed: int, on_step: Callable[[StepRecord], None] | None = None) -> Outcome:
    """Find the mug by all sensors that there are, and lift it by its handle.

    Same seed, same machine, and thinking that takes what the settings say: the same run. Ctrl-C ends it without a
    grasp.

    Args:
        parts: of the run.
        seed: of where the mug stands, of the noise and of the choices.
        on_step: called with the record of every step, the first view's included.
    """
    settings, task, rummager = parts.settings, parts.task, parts.rummager
    clock, history = Clock(), list[StepRecord]()
    random, planning = belief_streams(seed), split(seed, "plan")
    spent_s, updating_s, motion_s = 0.0, 0.0, task.settings.action_s + task.settings.hold_s

    def emit(record: StepRecord) -> StepRecord:
        history.append(record)
        if on_step is not None:
            on_step(record)
        return record

    def thought(began: float) -> float:
        """Seconds on the run's clock for what was thought since."""
        return time.perf_counter() - began if settings.thinking_s is None else settings.thinking_s

    ended: Ended = "steps"
    grasp, lifted = None, False
    try:
        with clock("simulate"):
            result = task.reset(seed)
        began = time.perf_counter()
        with clock("belief"):
            known = begin(parts.finder, result.reading, random=random)
        spent_s += thought(began)
        last = emit(observe(rummager, clock, history, result, known.belief, known.memory))
        plan: Plan | None = None
        while not last.converged and last.step < settings.steps:
            left_s = settings.budget_s - spent_s - motion_s - updating_s - GRASP_S
            if left_s < (settings.thinking_s or _LEAST_PLAN_S):
                ended = "budget"
                break
            began = time.perf_counter()
            with clock("plan"):
                scene = Scene(
                    rummager.model,
                    rummager.workspace,
                    rummager.tool,
                    result.reading.configuration,
                    observed=known.memory,
                    reading=result.reading,
                )
                executed, allowed = min(last.step, 1), None if settings.thinking_s is not None else left_s
                plan = rummager.policy.act(
                    known.belief, scene, plan, executed=executed, budget_s=allowed, generator=planning
                )
            spent_s += motion_s + thought(began)
            control = plan.controls[0]
            with clock("simulate"):
                result = task.step(control)
            began = time.perf_counter()
            known, last = follow(parts.finder, known, clock, history, result, control, plan, random=random)
            if settings.thinking_s is None:  # else it is part of the decision's time
                updating_s = thought(began)
                spent_s += updating_s
            emit(last)
        ended = "sure" if last.converged else ended
        grasp = best_grasp(known.belief.world_T_object, known.belief.log_weights, parts.table)
        lifted = parts.gripper.grasp(grasp.pose, task.world.world_T_object())
        spent_s += GRASP_S
    except KeyboardInterrupt:
        if not history:
            raise
        ended = "interrupted"
    # a recorded run knows no clock: there it is as if the actions had been all
    found = summarise(rummager, history, {"sure": "converged", "budget": "steps"}.get(ended, ended))
    nll = tuple(math.nan if record.nll is None else record.nll for record in history)
    return Outcome(found, ended, grasp, lifted, nll, total_nll(nll, settings.steps), spent_s)


def total_nll(nll: Sequence[float], steps: int) -> float:
    """Nll summed up over the first view and `steps` actions, the last one's for those that were not needed."""
    return math.fsum(nll) + nll[-1] * max(0, steps + 1 - len(nll))
