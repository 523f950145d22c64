"""Others' ways to do the work of `rumi bench`: public libraries, and the straightforward way written down."""

import math
import statistics
from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from kmppi import MPPI, MPPISettings, rollout_objective
from rumi.bench.case import Case, Setup, Variant
from rumi.bench.cases.reach import reach_inputs
from rumi.bench.cases.rollouts import push_scene
from rumi.bench.cases.sampling import free, sampling_settings, still
from rumi.bench.scenes import SCENES, view_scene
from rumi.dynamics.tool_lookup import world_height
from rumi.fields.information import InformationMode
from rumi.seeding import split
from scripts.bench import naive, peers
from sdf import se3
from sensors.semantics import semantics_probability

_REMARK = "CachedSDF and ComposedSDF: the nearest node of a table of 2.5 mm"
_LOOK_UPS = {"CachedSDF": peers.cached_lookup, "ComposedSDF": peers.composed_lookup}
_GOAL, _HILL = (1.5, 1.0), (0.7, 0.3)
Ways = tuple[Variant, ...]


def beside(name: str, case: Case, setup: Setup) -> Case:
    """A case with others' ways beside this project's, of which the quickest is what ratios are taken against."""
    kind, _, what = name.partition("-")
    own = NAIVE[kind](setup, what) if kind in NAIVE else ()
    others = PEERS[kind](setup, name) if kind in PEERS and peers.available(setup) else ()
    if kind == "kmppi":
        case = replace(case, facts=case.facts | closed_loop_facts(setup, name))
    return replace(
        case,
        variants=(*case.variants, *own, *others),
        baselines=case.baselines or tuple(v.name for v in (*others, *own) if v.share == 1.0 or not others),
        remarks=case.remarks + ((_REMARK,) if others and others[0].name in _LOOK_UPS else ()),
        left_out=case.left_out + (peers.left_out(setup) if kind in PEERS else ()),
    )


def _distances(setup: Setup, name: str) -> Ways:
    scene, gradient = SCENES[name.split("-")[1]](setup), name.startswith("gradient")
    # gradients of the two are in different frames: the distances are compared
    return tuple(
        Variant(label, look_up(scene.model, scene.world_T_object, scene.points, gradient=gradient), "peer")
        for label, look_up in _LOOK_UPS.items()
    )


def _fields(setup: Setup, name: str) -> Ways:
    scene = SCENES[name.split("-")[1]](setup)
    mode: InformationMode = "sensor_mi" if name.endswith("-mi") else "surrogate"

    def with_formula(look_up: Callable[[], tuple[Tensor, Tensor | None]]) -> Callable[[], tuple[Tensor, Tensor]]:
        return lambda: plain_formula(look_up()[0], scene.log_weights, mode)

    return tuple(
        Variant(
            label + ("+grad" if gradient else ""),
            with_formula(look_up(scene.model, scene.world_T_object, scene.points, gradient=gradient)),
            "peer",
        )
        for gradient in (False, True)
        for label, look_up in _LOOK_UPS.items()
    )


def plain_formula(
    distance: Float[Tensor, "N V"], log_weights: Float[Tensor, "N"], mode: InformationMode
) -> tuple[Float[Tensor, "V 3"], Float[Tensor, "V"]]:
    """Semantics and information as one writes them down from the paper (V.E, Eqs 4-6, 23, 27).

    The paper's field (`surrogate`) with lambda = 2 and C = 10, or the mutual information (`sensor_mi`).
    """
    weights = log_weights.exp()
    each = semantics_probability(distance)
    semantics = (weights[:, None, None] * each).sum(0)
    if mode == "sensor_mi":
        entropy = -torch.xlogy(semantics, semantics).sum(-1)
        own = -torch.xlogy(each, each).sum(-1)
        return semantics, entropy - (weights[:, None] * own).sum(0)
    costs = torch.stack((10.0 * (-distance).clamp_min(0), 10.0 * distance.clamp_min(0), distance.abs()), -1)
    return semantics, (semantics * 2.0 * (weights[:, None, None] * costs).sum(0)).sum(-1)


def _normals(setup: Setup, name: str) -> Ways:
    scene = SCENES[name.split("-")[1]](setup)
    poses, weights = scene.world_T_object, scene.log_weights.exp()
    cached, composed = (look_up(scene.model, poses, scene.points, gradient=True) for look_up in _LOOK_UPS.values())

    def turned() -> Tensor:
        slope = cached()[1]
        assert slope is not None
        return (weights[:, None, None] * (slope @ poses[:, :3, :3].mT)).sum(0)

    def summed() -> Tensor:
        slope = composed()[1]
        assert slope is not None
        return (weights[:, None, None] * slope).sum(0)

    return Variant("CachedSDF", turned, "peer"), Variant("ComposedSDF", summed, "peer")


def _discrepancies(setup: Setup, name: str) -> Ways:
    scene, gradient = view_scene(setup), name.endswith("gradient")
    variants = []
    for label, direct in (("chsel default", False), ("chsel Eq 3", True)):
        value, both, asked = peers.chsel_cost(
            scene.model, scene.world_T_object, scene.points[: scene.free], scene.points[scene.free :], direct=direct
        )
        which = f"asks about {asked} {'free' if direct else 'interior'} points"
        # the default's cost is another one, and gradients are to a matrix's entries
        variants.append(
            Variant(label, both if gradient else value, "peer", note=which, comparable=direct and not gradient)
        )
    return tuple(variants)


def _rollouts(setup: Setup, what: str) -> Ways:
    scene = push_scene(setup)

    @torch.no_grad()
    def run() -> tuple[Tensor, Tensor]:
        return naive.roll_out(scene.field, scene.tool, scene.model.settings, scene.start, scene.controls, scene.draws)

    return (Variant("all points, all steps", run, "naive"),)


def _gathering(setup: Setup) -> tuple[Callable[[], Tensor], Callable[[], Tensor], float]:
    """Eq 29 one rollout after the other by either way, and the share of rollouts that the second does."""
    scene = push_scene(setup)
    once = scene.roll_out()
    q, moved = once.configurations[:, :, 1:].flatten(0, 1), once.displacements[:, :, 1:].flatten(0, 1)
    points, grid = world_height(scene.tool.info, scene.tool.height_m).to(q), scene.information
    some = setup.size(50, 2)

    def thinned() -> Tensor:
        costs = []
        for path, shift in zip(q[:some], moved[:some], strict=True):
            met = (se3.apply(se3.from_planar(path), points) - shift[:, None]).reshape(-1, 3)
            costs.append(-grid.interpolate(peers.down_sample(met, grid.spacing)).sum())
        return torch.stack(costs)

    return lambda: -naive.gathered(grid, points, q, moved), thinned, some / len(q)


def _unique(setup: Setup, what: str) -> Ways:
    return (Variant("torch.unique", _gathering(setup)[0], "naive", note="one rollout after the other"),)


def _thinned(setup: Setup, name: str) -> Ways:
    _, run, share = _gathering(setup)
    note = "one rollout after the other, on a lattice of each one's own"
    return (Variant("voxel_down_sample", run, "peer", share=share, note=note),)


def _sums(setup: Setup, what: str) -> Ways:
    information, reachability, moved = reach_inputs(setup, SCENES[what](setup))
    few = moved[: setup.size(50, 5)]
    run = Variant("direct sums", lambda: naive.reach_cost(information, reachability, few), "naive")
    return (replace(run, share=len(few) / len(moved)),)


def _planners(setup: Setup, name: str) -> Ways:
    settings, dimensions = _size(setup, name, 0.01)
    command = peer_command(still, free, dimensions, settings, split(0, "bench/peer"), dimensions)
    state = torch.zeros(dimensions)
    return (Variant("pytorch-mppi", lambda: command(state), "peer"),)


def _size(setup: Setup, name: str, temperature: float) -> tuple[MPPISettings, int]:
    """Settings of a case of KMPPI, and its number of controls."""
    horizon, knots, dimensions = (15, 8, 3) if name == "kmppi-paper" else (20, 5, 2)
    return sampling_settings(setup.size(500, 20), horizon, knots, temperature), dimensions


def glide(state: Tensor, control: Tensor, *_: object) -> Tensor:
    """A point with a speed in the plane: state (x, y, vx, vy), control an acceleration."""
    speed = state[..., 2:] + 0.2 * control
    return torch.cat((state[..., :2] + 0.2 * speed, speed), -1)


def hilly(state: Tensor, control: Tensor, *_: object) -> Tensor:
    """Cost of being away from the goal, on the hill before it, quick, or pushed."""
    place = state[..., :2]
    hill = 5.0 * torch.exp(-(place - place.new_tensor(_HILL)).square().sum(-1) / 0.05)
    away = (place - place.new_tensor(_GOAL)).square().sum(-1)
    return away + hill + 0.05 * state[..., 2:].square().sum(-1) + 0.01 * control.square().sum(-1)


def _own(settings: MPPISettings, random: torch.Generator) -> Callable[[Tensor], Tensor]:
    mppi = MPPI(settings, 2)
    plan = mppi.from_knots(torch.zeros(mppi.parameterization.knots, 2))

    def command(state: Tensor) -> Tensor:
        nonlocal plan
        objective = rollout_objective(glide, hilly, state=state)
        plan, _ = mppi.plan(mppi.shift(plan, 1), objective, generator=random)
        return plan.controls[0]

    return command


def peer_command(
    step: Callable[..., Tensor],
    cost: Callable[..., Tensor],
    states: int,
    settings: MPPISettings,
    generator: torch.Generator,
    dimensions: int = 2,
) -> Callable[[Tensor], Tensor]:
    """The first control of each plan of pytorch_mppi's KMPPI."""
    assert settings.knots is not None
    planner = peers.make_kmppi(
        step,
        cost,
        states=states,
        variance=torch.ones(dimensions),
        samples=settings.samples,
        horizon=settings.horizon,
        knots=settings.knots,
        scale=settings.kernel_scale,
        temperature=settings.temperature,
        generator=generator,
    )
    command: Callable[[Tensor], Tensor] = planner.command
    return command


def closed_loop(make: Callable[[torch.Generator], Callable[[Tensor], Tensor]], seeds: int, steps: int) -> list[float]:
    """Summed cost of gliding over the hill to the goal, for each seed."""
    totals = []
    for seed in range(seeds):
        command = make(split(seed, "bench/navigation"))
        state, total = torch.zeros(4), 0.0
        for _ in range(steps):
            control = command(state)
            state = glide(state, control)
            total += float(hilly(state, control))
        totals.append(total)
    return totals


def closed_loop_facts(setup: Setup, name: str) -> dict[str, object]:
    """What either planner's closed loop costs over some seeds."""
    settings, _ = _size(setup, name, 0.1)
    seeds, steps = setup.size(6 if setup.quick else 20, 2), setup.size(25, 3)
    own = closed_loop(lambda g: _own(settings, g), seeds, steps)
    facts: dict[str, object] = {"closed-loop cost, rumi": _spread(own)}
    if peers.available(setup):
        theirs = closed_loop(lambda g: peer_command(glide, hilly, 4, settings, g), seeds, steps)
        facts["closed-loop cost, pytorch-mppi"] = _spread(theirs)
        error = math.hypot(*(statistics.stdev(costs) / seeds**0.5 for costs in (own, theirs)))
        gap = statistics.mean(own) - statistics.mean(theirs)
        facts["rumi's less pytorch-mppi's, standard errors"] = round(gap / max(error, 1e-12), 2)
    return facts


def _spread(costs: list[float]) -> str:
    return f"{statistics.mean(costs):.3f} +- {statistics.stdev(costs):.3f} ({len(costs)} seeds)"


NAIVE = {"rollouts": _rollouts, "trajectory": _unique, "reach": _sums}
PEERS = {
    "distance": _distances,
    "gradient": _distances,
    "field": _fields,
    "normal": _normals,
    "discrepancy": _discrepancies,
    "trajectory": _thinned,
    "kmppi": _planners,
}
"""By the first word of a case's name."""
