"""Registration of a drill under 600 points, as chsel tests itself."""

import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from rumi.bench.case import Case, Setup, Variant, case
from rumi.registration.register import RegisterSettings, register
from scripts.bench import drill, peers
from scripts.bench.modes import lost_modes, plausible_modes
from sdf.object_model import ObjectModel
from sensors.discrepancy import Discrepancy

_PEER = "chsel"
PEAKINESS = 50.0
"""Nats a metre of discrepancy; points that err by up to 5 mm, each for itself, would make it 400."""
FREE_SCALE = 20.0


def ours(
    model: ObjectModel, problem: drill.Problem, seed: int, settings: RegisterSettings | None = None
) -> Callable[[], Tensor]:
    """This project's registration: 100 poses."""
    discrepancy = Discrepancy(model.sdf, model.radius, free_scale=FREE_SCALE)

    def run() -> Tensor:
        random = torch.Generator().manual_seed(seed)
        found = register(discrepancy, problem.observation, PEAKINESS, settings, generator=random)
        return found.frame_T_object

    return run


def registration(setup: Setup) -> Case:
    """All of a registration, and how many of its poses are right."""
    model = drill.drill(0.005 if setup.tiny else 0.0025)
    each = setup.size(200, 40)
    seeds = range(setup.size(3 if setup.quick else 10, 1))
    problems = {seed: drill.problem(model.sdf, seed, each=each) for seed in seeds}
    settings = RegisterSettings(kept=10, starts=300, polished=60) if setup.tiny else None
    facts: dict[str, Any] = {"seeds": len(seeds), "kept": (settings or RegisterSettings()).kept}
    if setup.versions[-1] == "numba":
        facts |= _quality("rumi", model, problems, lambda p, seed: ours(model, p, seed, settings))
    variants = tuple(v for v in setup.ours(ours(model, problems[0], 0, settings)) if v.version != "torch" or setup.tiny)
    left_out = peers.left_out(setup)
    if peers.available(setup) and not setup.tiny:
        some = dict(list(problems.items())[: 1 if setup.quick else 3])
        facts |= _quality(_PEER, model, some, lambda p, seed: peers.chsel_register(model, *p.observation_parts, seed))
        run = peers.chsel_register(model, *problems[0].observation_parts, 0)
        variants += (Variant(_PEER, run, "peer", note="1 registration from the middle, 100 poses", comparable=False),)
    return Case(
        f"registration: {3 * each} points of a drill, centred, {facts['kept']} poses kept",
        variants,
        (_PEER,),
        setup.versions[-1],
        item="registration",
        facts=facts,
        left_out=left_out,
        rounds=5,
    )


# seed, slab of the drill (metres along its z axis), points of a class: views that several poses explain
VIEWS = ((1, 0.12, 0.2, 40), (3, 0.12, 0.2, 60), (4, 0.1, 0.2, 40), (5, 0.1, 0.2, 80), (6, 0.1, 0.2, 60))


def registration_modes(setup: Setup) -> Case:
    """Registration under points that several poses explain: how many of their modes are kept."""
    model = drill.drill(0.005 if setup.tiny else 0.0025)
    discrepancy = Discrepancy(model.sdf, model.radius, free_scale=FREE_SCALE)
    found, lost = [], []
    views = VIEWS[: setup.size(2 if setup.quick else len(VIEWS), 1)]
    for seed, low, high, count in views:
        view = drill.one_part(drill.problem(model.sdf, seed), low, high, count)
        random = torch.Generator().manual_seed(1000 + seed)
        starts = setup.size(20000, 2000)
        modes = plausible_modes(discrepancy, view.observation, PEAKINESS, starts=starts, generator=random)
        kept = ours(model, view, seed)()
        found.append(len(modes.mode.unique()))
        lost.append([round(weight, 3) for weight in lost_modes(modes, kept, model.sdf.bounds.mean(0))])
    first = drill.one_part(drill.problem(model.sdf, VIEWS[0][0]), *VIEWS[0][1:])
    return Case(
        f"registration of points of one part of a drill: {len(first.observation)} points, 100 poses kept",
        tuple(v for v in setup.ours(ours(model, first, 0)) if v.version == setup.versions[-1]),
        (),
        setup.versions[-1],
        item="registration",
        facts={"modes of each view": found, "weights of those lost": lost},
        rounds=5,
    )


def _quality(
    name: str,
    model: ObjectModel,
    problems: dict[int, drill.Problem],
    make: Callable[[drill.Problem, int], Callable[[], Tensor]],
) -> dict[str, Any]:
    """How many poses of each seed are within 5 mm, and what a registration takes, compiled code being there."""
    right: list[int] = []
    seconds: list[float] = []
    for seed, problem in problems.items():
        run = make(problem, seed)
        if not seconds:
            run()
        start = time.perf_counter()
        poses = run()
        seconds.append(time.perf_counter() - start)
        right.append(int((drill.surface_error(model, poses, problem.truth) < drill.FOUND_M).sum()))
    return {f"{name} within 5 mm": right, f"{name} median s": round(statistics.median(seconds), 3)}


# without the mesh there is nothing to register
if not drill.missing():
    case("registration", slow=True)(registration)
    case("registration-modes", slow=True)(registration_modes)
