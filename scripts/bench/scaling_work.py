"""The operations whose time and memory are measured over their size, on made-up beliefs of a mug."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterSettings, PoseFilter
from rumi.cache import cache_folder
from rumi.dynamics.contact import ContactField
from rumi.dynamics.displacement import DisplacementPush
from rumi.dynamics.displacement_rollouts import DisplacementRollouts
from rumi.dynamics.tool_lookup import world_height
from rumi.fields.information import information_field
from rumi.fields.normal import expected_normal
from rumi.fields.workspace import Workspace
from rumi.metrics.likelihood import negative_log_likelihood, self_agreement
from rumi.planning.costs import information_cost
from rumi.planning.policy import PlanRequest, Scene
from rumi.planning.reach_cost import ReachabilityCost
from rumi.planning.rummaging import RummagingPolicy, RummagingSettings
from rumi.registration.descent import DescentSettings, descend
from rumi.robot.tool import Tool
from rumi.seeding import split
from rumi.tasks.rummage.scenes import find_task, large_handled_mug, make_tool
from sdf import se3
from sdf.object_model import ObjectModel
from sdf.posed import posed_query
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics

Axis = Literal["particles", "points", "samples", "horizon", "scenes"]
Work = Callable[[], object]


@dataclass(frozen=True)
class Size:
    """How large a piece of work is; the defaults are the mug tasks'.

    Attributes:
        particles: of each belief.
        points: of the workspace.
        samples: control sequences of an iteration.
        horizon: actions.
        scenes: in a batch.
    """

    particles: int = 100
    points: int = 6561
    samples: int = 500
    horizon: int = 15
    scenes: int = 1


@cache
def model() -> ObjectModel:
    """The mug."""
    return large_handled_mug()


@cache
def tool() -> Tool:
    """The tasks' tool."""
    return make_tool(find_task("mug-1"), cache_dir=cache_folder())


def belief(size: Size) -> PoseBelief:
    """Poses about one place, yaw within about 40 degrees; a batch where there are several scenes."""
    batch = (size.scenes,) if size.scenes > 1 else ()
    noise = torch.randn(*batch, size.particles, 3, generator=split(0, "belief"))
    planar = noise * torch.tensor([0.002, 0.002, 0.35]) + torch.tensor([0.58, 0.0, 0.1])
    made = PoseBelief.uniform(se3.from_planar(planar))
    return made.reweighted(torch.randn(*batch, size.particles, generator=split(0, "weights")))


def space(size: Size) -> Workspace:
    """The tasks' planar workspace, as fine as gives the wanted number of points."""
    side = math.isqrt(size.points)
    bounds = torch.tensor([[0.0, -0.4, 0.045], [0.8, 0.4, 0.045]])
    return Workspace.from_bounds(bounds, 0.8 / (side - 1), planar_height=0.045)


def observation(size: Size) -> Observation:
    """300 surface points of the mug where the belief has it, and 2000 free points about them."""
    truth = se3.from_planar(torch.tensor([0.58, 0.0, 0.1]))
    surface = se3.apply(truth, model().surface_points[:300])
    share = torch.rand(6000, 3, generator=split(0, "free")) - 0.5
    places = share * torch.tensor([0.3, 0.3, 0.2]) + torch.tensor([0.58, 0.0, 0.1])
    free = places[model().exact.distance(se3.apply(se3.inverse(truth), places)) > 0.005][:2000]
    both = concatenate([Observation.of(surface, Semantics.SURFACE), Observation.of(free, Semantics.FREE)])
    if size.scenes == 1:
        return both
    parts = (both.points, both.semantics, both.attached, both.valid)
    return Observation(*(part.expand(size.scenes, *part.shape) for part in parts))


def discrepancy() -> Discrepancy:
    """C^ with the filter's settings."""
    settings = FilterSettings()
    return Discrepancy(model().sdf, model().radius, free_scale=settings.free_scale, tolerance=settings.tolerance_m)


def controls(size: Size) -> Float[Tensor, "K H 3"]:
    """Random ones, forward on the whole so that many touch."""
    drawn = torch.rand(size.samples, size.horizon, 3, generator=split(0, "controls")) * 2 - 1
    return (drawn + torch.tensor([0.4, 0.0, 0.0])).clamp(-1.0, 1.0)


def _field(size: Size) -> Work:
    held, where = belief(size), space(size).points
    return lambda: information_field(model().sdf, held.world_T_object, held.log_weights, where)


def _normal(size: Size) -> Work:
    held, where = belief(size), space(size).points
    return lambda: expected_normal(model().sdf, held.world_T_object, held.log_weights, where)


def _query(size: Size) -> Work:
    held, seen = belief(size), observation(size)
    return lambda: posed_query(model().sdf, held.world_T_object, seen.points)


def _discrepancy(size: Size) -> Work:
    held, seen, cost = belief(size), observation(size), discrepancy()
    return lambda: cost(held.world_T_object, seen)


def _descent(size: Size) -> Work:
    held, seen, cost = belief(size), observation(size), discrepancy()
    return lambda: descend(cost, held.world_T_object, seen, "SE(2)", DescentSettings())


def _resample(size: Size) -> Work:
    held, seen = belief(size), observation(size)
    pose_filter = PoseFilter(FilterSettings(trigger=0.0), [discrepancy()], "SE(2)")
    known = replace(held, discrepancy=pose_filter.total(held, seen))
    return lambda: pose_filter.resample(known, known, seen, generator=split(0, "resample"))


def _agreement(size: Size) -> Work:
    held, points = belief(size), model().surface_points[::3]
    return lambda: self_agreement(held, points, model().sdf)


def _mode(size: Size) -> Work:
    held = belief(size)
    return lambda: held.mode()


def _nll(size: Size) -> Work:
    held, points = belief(size), model().surface_points
    truth = se3.from_planar(torch.tensor([0.58, 0.0, 0.1])).expand(*held.log_weights.shape[:-1], 4, 4)
    return lambda: negative_log_likelihood(held.world_T_object, held.log_weights, truth, points, model().sdf)


def _contact(size: Size) -> tuple[ContactField, Workspace]:
    held, where = belief(size), space(size)
    fields = information_field(model().sdf, held.world_T_object, held.log_weights, where.points)
    return ContactField.from_belief(model().sdf, held.world_T_object, held.log_weights, where, fields), where


def _push_model(size: Size) -> Work:
    contact, _ = _contact(size)
    return lambda: DisplacementRollouts(contact, tool())


def _rollouts(size: Size) -> Work:
    push, wanted = DisplacementRollouts(_contact(size)[0], tool()), controls(size)
    start, rollouts = torch.tensor([0.4, 0.0, 0.0]), DisplacementPush.defaults.rollouts
    return lambda: push.rollout(start, wanted, rollouts=rollouts, generator=split(0, "rollouts"))


def _information_cost(size: Size) -> Work:
    held, where = belief(size), space(size)
    fields = information_field(model().sdf, held.world_T_object, held.log_weights, where.points)
    path = tool().free_path(torch.tensor([0.4, 0.0, 0.0]).expand(size.samples, 3), controls(size), 1)
    still, points = torch.zeros_like(path), world_height(tool().info, tool().height_m)
    return lambda: information_cost(where.grid(fields.information), points, path, still, discount=0.9, normalise=True)


def _reach_cost(size: Size) -> Work:
    where = space(size)
    grid = where.grid(torch.rand(len(where), generator=split(0, "grid")))
    moves = 0.05 * torch.randn(size.samples * 5, size.horizon, 3, generator=split(0, "moves"))
    return lambda: ReachabilityCost(grid, grid)(moves)


def _plan(size: Size) -> Work:
    held, where = belief(size), space(size)
    base = RummagingSettings(push_model="displacement")
    mppi = replace(base.mppi, samples=size.samples, horizon=size.horizon, knots=min(8, size.horizon))
    scene = Scene(model(), where, tool(), torch.tensor([0.4, 0.0, 0.0]))
    reach = tool().reach
    assert reach is not None
    policy = RummagingPolicy(reach.field(where.points), replace(base, mppi=replace(mppi, warmup_iterations=2)))
    return lambda: policy.act(PlanRequest(held, scene, generator=split(0, "plan")))


WORK: dict[str, tuple[Callable[[Size], Work], tuple[Axis, ...]]] = {
    "information_field": (_field, ("particles", "points", "scenes")),
    "expected_normal": (_normal, ("particles", "points", "scenes")),
    "posed_query": (_query, ("particles",)),
    "discrepancy": (_discrepancy, ("particles", "scenes")),
    "descend": (_descent, ("particles", "scenes")),
    "filter.resample": (_resample, ("particles", "scenes")),
    "self_agreement": (_agreement, ("particles", "scenes")),
    "belief.mode": (_mode, ("particles",)),
    "negative_log_likelihood": (_nll, ("particles",)),
    "push model": (_push_model, ("points",)),
    "rollouts": (_rollouts, ("samples", "horizon")),
    "information_cost": (_information_cost, ("samples", "horizon", "points")),
    "reachability cost": (_reach_cost, ("samples", "points")),
    "planning pass": (_plan, ("particles", "points", "samples", "horizon")),
}
"""Operations by name: how to set one up, and along which axes its size is changed."""
SIZES: dict[Axis, tuple[int, ...]] = {
    "particles": (10, 100, 1_000, 10_000, 100_000),
    "points": (1_000, 10_000, 100_000, 1_000_000, 10_000_000),
    "samples": (10, 100, 1_000, 10_000, 100_000),
    "horizon": (5, 15, 50, 150),
    "scenes": (1, 10, 100, 1_000),
}
