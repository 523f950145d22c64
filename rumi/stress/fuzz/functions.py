"""Public functions under tensors of any value: documented errors, or finite numbers from finite ones."""

import math
from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from kmppi import MPPI, KernelKnots, MPPISettings, kernel_matrix, sample_weights
from kmppi.types import KernelName
from rumi.belief.entropy import ENTROPIES, SharedSupport, make_entropy
from rumi.belief.expected_gain import binary_outcome, channel_capacity
from rumi.belief.particles import PoseBelief, boltzmann
from rumi.belief.resampling import resample_systematic
from rumi.belief.states import StateMetric
from rumi.errors import DegenerateBeliefError
from rumi.fields.information import InformationSettings, information_field
from rumi.fields.normal import expected_normal
from rumi.fields.workspace import Workspace
from rumi.metrics.correlation import pearson, run_correlation, spearman
from rumi.metrics.intervals import bootstrap_median, mcnemar, wilson
from rumi.metrics.likelihood import negative_log_likelihood, self_agreement
from rumi.planning.costs import information_cost
from rumi.registration.descent import DescentSettings, descend
from rumi.stress.fuzz.draw import Draw, choice, log_weights, number, poses, sizes, tensor
from sdf import se3, so3
from sdf.grid_sdf import GridSDF
from sdf.lookup import trilinear
from sdf.posed import posed_distance, posed_query
from sdf.primitives import Box, Capsule, Cup, Cylinder, Mug, Sphere, TorusArc
from sdf.triangles import Triangles
from sdf.voxel_grid import VoxelGrid, lattice_keys
from sensors.camera import depth_observation, pinhole
from sensors.contact_model import ContactModel
from sensors.discrepancy import Discrepancy, normal_equations
from sensors.observation import Observation, merge
from sensors.semantics import semantics_probability
from sensors.tactile import swept_points
from sensors.touch_likelihood import TouchNoise, touch_log_likelihoods

DOCUMENTED = (ValueError, DegenerateBeliefError)
"""What public functions raise on what they cannot take."""

Target = Callable[[Draw], Iterable[Tensor]]
FUNCTIONS: dict[str, Target] = {}
"""Targets by name: each makes a case of its draw and gives numbers that must be finite, as those that came in were."""


def target(function: Target) -> Target:
    """Decorator that enters a target."""
    FUNCTIONS[function.__name__.strip("_").replace("_", "-")] = function
    return function


def _finite(*given: Tensor) -> bool:
    return all(bool(torch.isfinite(one).all()) and bool((one.abs() < 1e4).all()) for one in given)


def _out(given: Iterable[Tensor], *results: Tensor) -> tuple[Tensor, ...]:
    """Results to be looked at: those of finite input only."""
    return results if _finite(*given) else ()


_TABLE = GridSDF.from_sdf(Box((0.03, 0.05, 0.08)), 0.01)


def _table(like: Tensor) -> GridSDF:
    x, y, z = _TABLE.origin
    return GridSDF(_TABLE.values.to(like), (x, y, z), 0.01, _TABLE.bounds.to(like), outer=_TABLE.outer)


@target
def _transforms(draw: Draw) -> Iterable[Tensor]:
    wild = draw.integer(0, 1) == 1
    twist = tensor(draw, sizes(draw), 6, wild=wild)
    pose = se3.exp(twist)
    log = se3.log(pose)
    distance = se3.distance(pose, se3.identity(dtype=pose.dtype))
    others = (se3.inverse(pose), se3.compose(pose, pose), se3.from_planar(twist[:, :3]), se3.to_planar(pose))
    if _finite(twist):
        se3.reproject(pose)
    return _out((twist,), pose, log, *distance, *others, so3.angle(pose[..., :3, :3]))


@target
def _mean_of_poses(draw: Draw) -> Iterable[Tensor]:
    count = draw.integer(1, 5)
    group, weights = poses(draw, count), tensor(draw, count, wild=draw.integer(0, 1) == 1).abs()
    if not _finite(weights) or float(weights.sum()) < 1e-20:
        weights = weights * 0.0
    return _out((group, weights), se3.mean(group, weights))


@target
def _gradients(draw: Draw) -> Iterable[Tensor]:
    twist = tensor(draw, 4, 6).requires_grad_()
    with torch.enable_grad():
        pose = se3.exp(twist)
        total = se3.log(pose).square().sum() + so3.angle(pose[..., :3, :3]).sum()
        (gradient,) = torch.autograd.grad(total, twist)
    return _out((twist.detach(),), gradient)


@target
def _primitives(draw: Draw) -> Iterable[Tensor]:
    def size() -> float:
        return number(draw, wild=draw.integer(0, 3) == 0)

    shape = choice(
        draw,
        (
            lambda: Sphere(size()),
            lambda: Box((size(), size(), size())),
            lambda: Cylinder(size(), size()),
            lambda: Capsule((size(), size(), size()), (0.0, 0.0, 0.1), size()),
            lambda: TorusArc((0.0, 0.0, 0.0), size(), size(), size()),
            lambda: Cup(size(), size(), size(), size()),
            lambda: Mug(abs(size()) + 0.03, abs(size()) + 0.09),
        ),
    )()
    points = tensor(draw, sizes(draw), 3, wild=True)
    query = shape(points)
    if not bool(torch.isfinite(shape.bounds).all()):
        raise AssertionError("a shape of infinite size was taken")
    return query.distance, query.gradient


@target
def _tables(draw: Draw) -> Iterable[Tensor]:
    points = tensor(draw, sizes(draw), 3, wild=True)
    query = _table(points)(points)
    return query.distance, query.gradient


@target
def _look_ups(draw: Draw) -> Iterable[Tensor]:
    values = tensor(draw, *(draw.integer(1, 4) for _ in range(3)))
    points = tensor(draw, sizes(draw), 3, wild=True).to(values)
    query = trilinear(values, tensor(draw, 3).to(values), choice(draw, (1e-3, 0.1, 1.0)), points)
    return query.distance, query.gradient


@target
def _lattices(draw: Draw) -> Iterable[Tensor]:
    bounds = tensor(draw, 2, 3, wild=draw.integer(0, 2) == 0)
    if draw.integer(0, 2):
        bounds = bounds.sort(0).values
    spacing = choice(draw, (0.05, 0.2, 1.0, number(draw, wild=True)))
    if 1e5 < float(((bounds[1] - bounds[0]).double() / spacing).abs().clamp_min(1.0).prod()) < 2**29:
        return ()  # takes long
    grid = VoxelGrid.from_bounds(bounds, spacing)
    points = tensor(draw, sizes(draw), 3, wild=True).to(bounds)
    index, _ = grid.nearest_index(points)
    if index.numel() and (bool((index < 0).any()) or bool((index >= torch.tensor(grid.shape)).any())):
        raise AssertionError("an index beyond the lattice")
    return grid.interpolate(points), grid.interpolate(points, None)


@target
def _keys(draw: Draw) -> Iterable[Tensor]:
    return (lattice_keys(tensor(draw, sizes(draw), 3, wild=True), choice(draw, (0.001, 0.005, 1.0))).double(),)


@target
def _workspaces(draw: Draw) -> Iterable[Tensor]:
    bounds = tensor(draw, 2, 3, wild=draw.integer(0, 2) == 0)
    if draw.integer(0, 2):
        bounds = bounds.sort(0).values
    made = Workspace.from_bounds(bounds, choice(draw, (0.05, 0.2, 1.0, number(draw, wild=True))))
    return (made.bounds,) if len(made) > 10**6 else (made.bounds, made.points)


@target
def _posed(draw: Draw) -> Iterable[Tensor]:
    at = poses(draw, sizes(draw), wild=draw.integer(0, 2) == 0)
    points = tensor(draw, sizes(draw, 20), 3, wild=True).to(at)
    query = posed_query(_table(at), at, points)
    distance = posed_distance(_table(at), at, points)
    # a pose that is none moves points to nowhere, which is far: never NaN
    return (distance, query.distance, *_out((at,), query.gradient))


def _observed(draw: Draw, wild: bool) -> Observation:
    parts = [Observation.of(tensor(draw, sizes(draw), 3, wild=wild).float(), kind) for kind in range(3)]
    spacing = torch.tensor([0.005, 0.005, 0.002])
    total = parts[0]
    for part in parts[1:]:
        total, _ = merge(total, part, spacing)
    return total


@target
def _observations(draw: Draw) -> Iterable[Tensor]:
    seen = _observed(draw, wild=True)
    return (seen.points,)


@target
def _discrepancies(draw: Draw) -> Iterable[Tensor]:
    at, seen = poses(draw, sizes(draw)).float(), _observed(draw, wild=False)
    module = Discrepancy(_TABLE, 0.1, free_scale=abs(number(draw)), tolerance=abs(number(draw)) * 0.01)
    terms = normal_equations(_TABLE, at, seen.points, seen.semantics, seen.valid)
    settings = DescentSettings(method=choice(draw, ("gauss-newton", "adam")), iterations=2)
    moved = descend(module, at, seen, choice(draw, ("SE(2)", "SE(3)")), settings)
    return (module(at, seen), *terms, moved)


@target
def _sensor_models(draw: Draw) -> Iterable[Tensor]:
    distance = tensor(draw, sizes(draw), wild=draw.integer(0, 1) == 1)
    chances = semantics_probability(distance, abs(number(draw)), abs(number(draw)))

    def rate() -> float:
        return number(draw, wild=True) if draw.integer(0, 7) == 0 else draw.integer(0, 100) / 100

    decay = choice(draw, (None, 10.0 ** draw.integer(-3, 6), 10.0 ** draw.integer(-3, 6), number(draw, wild=True)))
    model = ContactModel(rate(), rate(), decay)
    contact = torch.arange(len(distance)) % 2 == 0
    return _out((distance,), chances, model(distance), model.log_likelihood(distance, contact))


_BOX = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])[
    torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
]


@target
def _touches(draw: Draw) -> Iterable[Tensor]:
    sigmas = [10.0 ** draw.integer(-6, 1) if draw.integer(0, 9) else number(draw, wild=True) for _ in range(3)]
    noise = TouchNoise(sigmas[0], sigmas[1], choice(draw, (0.0, 0.0, 0.3, number(draw))), sigmas[2])
    at, points = poses(draw, draw.integer(1, 3)).double(), tensor(draw, draw.integer(1, 4), 3).double()
    normals = torch.nn.functional.normalize(tensor(draw, len(points), 3).double(), dim=-1)
    corners = _BOX.double() * (0.0 if draw.integer(0, 9) == 0 else 0.1)
    return (touch_log_likelihoods(at, points, normals, Triangles(corners), noise),)


@target
def _depth_images(draw: Draw) -> Iterable[Tensor]:
    depth = tensor(draw, draw.integer(1, 5), draw.integer(1, 5), wild=True).float()
    camera = poses(draw, wild=draw.integer(0, 3) == 0).float()
    intrinsics = (
        pinhole(depth.shape[0], depth.shape[1], 1.0) if draw.integer(0, 2) else tensor(draw, 3, 3, wild=True).float()
    )
    bounds = choice(draw, (None, torch.tensor([[-0.05] * 3, [0.05] * 3])))
    seen = depth_observation(depth, intrinsics, camera, depth > 0, bounds=bounds, free_spacing=0.02)
    return (seen.points,)


@target
def _swept(draw: Draw) -> Iterable[Tensor]:
    instants = draw.integer(1, 3)
    region = torch.tensor([[-1.0] * 3, [1.0] * 3])
    path = se3.exp(0.05 * tensor(draw, instants, 6)).float()
    body = 0.1 * tensor(draw, sizes(draw), 3).float()
    points, _ = swept_points(path, body, choice(draw, (0.02, 0.1)), region=region)
    return (points.points,)


@target
def _beliefs(draw: Draw) -> Iterable[Tensor]:
    count = sizes(draw)
    start = PoseBelief.uniform(poses(draw, count))
    wild = draw.integer(0, 1) == 1
    weighed = start.reweighted(log_weights(draw, count, wild=wild).to(start.log_weights))
    cost = tensor(draw, count, wild=wild).abs().to(start.log_weights)
    again = weighed.reweighted(boltzmann(cost, abs(number(draw)) + 1e-9))
    index = resample_systematic(again.log_weights, generator=torch.Generator().manual_seed(0))
    if bool((index < 0).any()) or bool((index >= count).any()):
        raise AssertionError("a particle that there is none of")
    return again.weights, again.ess(), again.mode(), again.mean(), again.resampled(index).world_T_object


@target
def _fields(draw: Draw) -> Iterable[Tensor]:
    count = draw.integer(1, 5)
    at, points = poses(draw, count), tensor(draw, sizes(draw), 3, wild=True)
    belief = PoseBelief.uniform(at).reweighted(log_weights(draw, count).to(at))
    settings = InformationSettings(
        mode=choice(draw, ("sensor_mi", "surrogate", "reverse_kl", "forward_kl")),
        peakiness=abs(number(draw)),
        free_scale=abs(number(draw)),
        tolerance=abs(number(draw)) * 0.01,
        sharpness=abs(number(draw)) + 1e-3,
        tail=choice(draw, (0.0, 1e-6)),
    )
    fields = information_field(_table(at), at, belief.log_weights, points.to(at), settings)
    normal = expected_normal(_table(at), at, belief.log_weights, points.to(at))
    return fields.semantics, fields.information, *_out((points,), normal)


@target
def _metrics(draw: Draw) -> Iterable[Tensor]:
    count = draw.integer(1, 4)
    at = poses(draw, count)
    belief = PoseBelief.uniform(at).reweighted(log_weights(draw, count).to(at))
    surface = 0.1 * tensor(draw, draw.integer(1, 5), 3).to(at)
    nll = negative_log_likelihood(at, belief.log_weights, at[0], surface, _table(at))
    return (nll, *self_agreement(belief, surface, _table(at)))


@target
def _entropies(draw: Draw) -> Iterable[Tensor]:
    count = draw.integer(1, 6)
    states = tensor(draw, count, 3)
    if draw.integer(0, 1):
        states[-1] = states[0]
    log = log_weights(draw, count).to(states)
    log[0] = 0.0
    support = SharedSupport(StateMetric.planar(0.1), draw.integer(2, 5), floor=1e-3)
    chance = tensor(draw, count).abs().clamp(0.0, 1.0).to(states)
    gain = binary_outcome(log, chance)
    estimate = make_entropy(choice(draw, ENTROPIES), support)(states, log)  # type: ignore[arg-type]
    return estimate, *gain


@target
def _channels(draw: Draw) -> Iterable[Tensor]:
    rates = [number(draw, wild=True) if draw.integer(0, 3) == 0 else draw.integer(0, 10**9) * 1e-9 for _ in range(2)]
    return (torch.tensor(channel_capacity(min(rates), max(rates))),)


@target
def _sample_weights(draw: Draw) -> Iterable[Tensor]:
    costs = tensor(draw, draw.integer(1, 6), wild=True)
    return (sample_weights(costs, 10.0 ** draw.integer(-6, 6), cost_scale=choice(draw, ("raw", "std"))),)


@target
def _time_kernels(draw: Draw) -> Iterable[Tensor]:
    kernel: KernelName = choice(draw, ("rbf", "matern32", "matern52", "bspline3"))
    horizon = draw.integer(1, 12)
    knots = draw.integer(1, horizon)
    made = KernelKnots(horizon, knots, kernel, 10.0 ** draw.integer(-2, 2))
    times = tensor(draw, 4).abs()
    return made.matrix, made.shift_matrix(draw.integer(0, 15)), kernel_matrix(kernel, times, times, 2.0)


@target
def _planners(draw: Draw) -> Iterable[Tensor]:
    def positive() -> float:
        return 10.0 ** draw.integer(-8, 8) if draw.integer(0, 9) else number(draw, wild=True)

    settings = MPPISettings(
        horizon=draw.integer(0, 9),
        knots=choice(draw, (None, None, 1, 2)),
        changes=draw.integer(0, 5) == 0,
        samples=draw.integer(2, 6),
        noise_variance=positive(),
        temperature=positive(),
        kernel_scale=choice(draw, (0.5, 0.5, 0.5, positive())),
        control_min=choice(draw, (-1.0, -1.0, -1e-9, number(draw, wild=True))),
        change_cost=choice(draw, (0.0, 0.0, positive())),
    )
    planner, generator = MPPI(settings, 2), torch.Generator().manual_seed(draw.integer(0, 99))
    costs = tensor(draw, settings.samples, wild=True).float()
    plan, rollouts = planner.plan(planner.initial(generator=generator), lambda _: costs, generator=generator)
    return plan.controls, planner.shift(plan, draw.integer(0, 6)).controls, rollouts.weights, rollouts.ess


@target
def _path_costs(draw: Draw) -> Iterable[Tensor]:
    values = tensor(draw, draw.integer(1, 4), draw.integer(1, 4), draw.integer(1, 3)).abs().float()
    field = VoxelGrid(values * choice(draw, (0.0, 1.0, 1e-30)), tensor(draw, 3).float(), choice(draw, (0.01, 1.0)))
    rollouts, steps = sizes(draw, 3), draw.integer(1, 3)
    paths, moves = tensor(draw, rollouts, steps, 3).float(), tensor(draw, rollouts, steps, 3).float()
    normalise = draw.integer(0, 1) == 1
    return (information_cost(field, tensor(draw, sizes(draw), 3).float(), paths, moves, normalise=normalise),)


@target
def _statistics(draw: Draw) -> Iterable[Tensor]:
    wild = draw.integer(0, 3) == 0
    values = [number(draw, wild=wild) for _ in range(sizes(draw))]
    others = [number(draw, wild=wild) for _ in range(len(values) if draw.integer(0, 3) else sizes(draw))]
    low, high = wilson(draw.integer(-1 if wild else 0, 2), draw.integer(2, 4))
    mcnemar([v > 0 for v in values], [v > 0 for v in others])
    found = [low, high, *bootstrap_median(values, resamples=5)]
    # not numbers where there is no correlation, as documented
    both = [pearson(values, others), spearman(values, others), *run_correlation([(values, others)], resamples=5)]
    if any(math.isinf(x) for x in both):
        raise AssertionError("an infinite correlation")
    return (torch.tensor([x for x in found if abs(x) < 1e30]),)
