"""The algorithm, top to bottom: look, then plan, act, sense, update, until sure (RUMI, Alg 1)."""

from collections.abc import Callable

import torch

from rumi.belief.initialise import initialise, view_starts
from rumi.belief.particles import PoseBelief
from rumi.belief.reinitialise import challenge, prior_belief, redraw
from rumi.clock import Clock
from rumi.planning.policy import Plan, Scene
from rumi.records import RunResult, StepRecord
from rumi.seeding import split
from rumi.task import Task
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.scoring import observe, summarise
from sensors.observation import Observation, merge
from sensors.reading import Reading
from sensors.semantics import Semantics


def rummage(
    task: Task, rummager: Rummager, *, seed: int, steps: int, on_step: Callable[[StepRecord], None] | None = None
) -> RunResult:
    """Find the object's pose by touching it (RUMI, Alg 1).

    Same seed, same task, same device and no budget: the same run, byte for byte. Ctrl-C ends the run with what it has.
    With a budget a plan is made first that nobody follows, since the first one of a process loads compiled code.

    Args:
        task: a simulator or hardware.
        rummager: how.
        seed: of all randomness.
        steps: actions at most.
        on_step: called with the record of every step, the first view's included.
    """
    clock = Clock()
    history: list[StepRecord] = []
    random = {name: split(seed, name) for name in ("initialise", "filter", "plan", "renewal")}
    place = (rummager.model, rummager.workspace, rummager.tool)
    unseen = rummager.filter.prior is not None
    renews, challenges = unseen and rummager.renewal.at_contact, unseen and rummager.renewal.challenge

    def emit(record: StepRecord) -> StepRecord:
        history.append(record)
        if on_step is not None:
            on_step(record)
        return record

    stopped_by = "steps"
    try:
        with clock("simulate"):
            result = task.reset(seed)
        with clock("belief"):
            belief, memory = first_belief(rummager, result.reading, generator=random["initialise"])
        last = emit(observe(rummager, clock, history, result, belief, memory))
        plan: Plan | None = None
        executed, surprised = 0, False
        if rummager.budget_s is not None and not last.converged and steps > 0:
            with clock("warm_up"):
                scene = Scene(*place, result.reading.configuration, observed=memory, reading=result.reading)
                rummager.policy.act(belief, scene, None, executed=0, budget_s=0.0, generator=split(seed, "warm_up"))
        while not last.converged and last.step < steps:
            if plan is None or surprised or executed >= min(rummager.replan_every, len(plan.controls)):
                scene = Scene(*place, result.reading.configuration, observed=memory, reading=result.reading)
                with clock("plan"):
                    plan = rummager.policy.act(
                        belief, scene, plan, executed=executed, budget_s=rummager.budget_s, generator=random["plan"]
                    )
                executed = 0
            control = plan.controls[executed]
            with clock("simulate"):
                result = task.step(control)
            executed += 1
            with clock("belief"):
                belief, memory, info = rummager.filter(belief, memory, result.reading, generator=random["filter"])
                if renews and last.contacts == 0 and bool(result.reading.in_contact.any()):
                    belief = redraw(rummager.filter, belief, memory, rummager.renewal, generator=random["renewal"])
            # what was touched, by the pads or not, is not where the plan had it
            surprised = bool(info.moved) or bool(result.reading.in_contact.any())
            done = (control, plan, bool(info.resampled))
            last = observe(rummager, clock, history, result, belief, info.added, *done)
            if last.converged and challenges:
                clock.put_back(last.timings_s)
                with clock("belief"):
                    belief = challenge(rummager.filter, belief, memory, rummager.renewal, generator=random["renewal"])
                last = observe(rummager, clock, history, result, belief, info.added, *done)
            emit(last)
        if last.converged:
            stopped_by = "converged"
    except KeyboardInterrupt:
        if not history:
            raise
        stopped_by = "interrupted"
    return summarise(rummager, history, stopped_by)


def first_belief(rummager: Rummager, reading: Reading, *, generator: torch.Generator) -> tuple[PoseBelief, Observation]:
    """The belief and the memory after the first view, or without one from the prior (Alg 1, lines 1-3)."""
    points = reading.observation.points
    none = Observation.empty(dtype=points.dtype, device=points.device)
    memory, _ = merge(none, reading.observation, rummager.filter.lattice)
    if rummager.filter.prior is not None:
        return prior_belief(rummager.filter, memory, rummager.initialise.particles, generator=generator), memory
    surface = memory.points[memory.of_class(Semantics.SURFACE)]
    if len(surface) == 0:
        raise ValueError("Expected a first view with surface points of the object, got none: check the object's mask")
    settings = rummager.initialise
    reach_m = float(rummager.model.surface_points[:, :2].norm(dim=-1).max())
    starts = view_starts(surface, settings.starts, reach_m, rummager.height_m, generator=generator)
    belief = initialise(
        rummager.filter.discrepancy,
        memory,
        starts,
        rummager.filter.search,
        rummager.filter.settings.peakiness,
        settings,
        generator=generator,
    )
    return belief, memory
