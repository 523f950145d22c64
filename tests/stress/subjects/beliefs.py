"""Beliefs: weights from discrepancies, normalising, effective sizes, resampling, means and modes."""

import math
from dataclasses import replace
from functools import cache, partial

import torch
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.resampling import systematic
from rumi.weights import boltzmann
from sdf import se3, so3
from sdf.grid_sdf import GridSDF
from sdf.primitives import Mug
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation
from tests.stress import measures
from tests.stress.draws import (
    choice,
    integer,
    log_uniform,
    log_weights,
    mixed,
    normal,
    poses,
    rotation_vectors,
    uniform,
)
from tests.stress.measures import of_pose
from tests.stress.on_device import here
from tests.stress.sweep import Inputs, Sweep, register

EPS = torch.finfo(torch.float32).eps
ROWS = 64
SIZES = (1, 2, 3, 30, 500, 500, 500, 5000, 100000)


def _belief(like: Tensor) -> PoseBelief:
    """A belief of as many particles in each row, all at one pose."""
    rows, count = like.shape
    return PoseBelief.uniform(se3.identity((rows, 1), dtype=like.dtype).expand(rows, count, 4, 4))


def _rows(count: int) -> int:
    return max(1, min(ROWS, 200000 // count))


# weights


def _draw_weights(generator: torch.Generator) -> Inputs:
    count = int(choice(generator, SIZES))
    return {"log_weights": log_weights(generator, _rows(count), count).float()}


def _weights_error(got: Tensor, wanted: Tensor, inputs: Inputs) -> Tensor:
    """Of the log-weights, in units of 10 eps times their size (1 at least); weights that sum to 1 within 1e-5."""
    log, sums = got.double(), (got.double().exp().sum(-1) - 1.0).abs() / 1e-5
    off = torch.where(log == wanted, 0.0, (log - wanted).abs()) / (10 * EPS * wanted.abs().clamp_min(1.0))
    return torch.maximum(torch.where(wanted == -math.inf, (log != wanted).double(), off).amax(-1), sums)


def _spread(inputs: Inputs) -> Tensor:
    log = inputs["log_weights"].double()
    least = torch.where(log > -math.inf, log, math.inf).amin(-1)
    return log.amax(-1) - least


def _draw_costs(within: bool, generator: torch.Generator) -> Inputs:
    """Discrepancies of up to 1e6 and lambdas of 1e-3 to 1e5; `within`, lambda times their spread is 100 at most."""
    count = int(choice(generator, SIZES))
    rows = _rows(count)
    peakiness = float(log_uniform(generator, 1, low=1e-3, high=1e5))
    share = mixed(generator, [uniform(generator, rows, count), log_uniform(generator, rows, count, low=1e-9, high=1.0)])
    least = log_uniform(generator, rows, 1, low=1e-6, high=1e6)
    most = 100.0 / peakiness if within else 1e6
    cost = (least + share * log_uniform(generator, rows, 1, low=1e-6, high=1.0) * most).clamp_max(1e6).float()
    if within:
        cost = torch.minimum(cost, cost.amin(-1, keepdim=True) + 0.999 * most)
    return {"discrepancy": cost, "peakiness": peakiness}


def _weigh(inputs: Inputs) -> Tensor:
    cost = inputs["discrepancy"]
    return _belief(cost).reweighted(boltzmann(cost, inputs["peakiness"])).log_weights


def _wanted_weights(inputs: Inputs) -> Tensor:
    cost = inputs["discrepancy"].double()
    return torch.log_softmax(-inputs["peakiness"] * cost, -1)


def _beyond_error(got: Tensor, wanted: Tensor, inputs: Inputs) -> Tensor:
    """Of log-weights, in units of 10 eps lambda times the greatest discrepancy; of 1e-4 where that is less."""
    allowed = 10 * EPS * inputs["peakiness"] * inputs["discrepancy"].double().amax(-1)
    return measures.absolute(got, wanted) / allowed.clamp_min(1e-4)


def _cost_spread(inputs: Inputs) -> Tensor:
    cost = inputs["discrepancy"].double()
    return inputs["peakiness"] * (cost.amax(-1) - cost.amin(-1))


# sizes and samples


def _ess_error(got: Tensor, wanted: Tensor, inputs: Inputs) -> Tensor:
    """Relative; a size below 1 or above the number of particles is wrong altogether."""
    count = inputs["log_weights"].shape[-1]
    outside = (got.double() < 1.0 - 1e-6) | (got.double() > count * (1.0 + EPS))
    return torch.where(outside, 1.0, (got.double() / wanted - 1.0).abs())


def _wanted_ess(inputs: Inputs) -> Tensor:
    weights = torch.softmax(inputs["log_weights"].double(), -1)
    return weights.sum(-1).square() / weights.square().sum(-1)


def _draw_comb(generator: torch.Generator) -> Inputs:
    inputs = dict(_draw_weights(generator))
    rows = len(inputs["log_weights"])
    edges = torch.where(uniform(generator, rows) < 0.5, 0.0, 1.0 - 1e-12).double()
    return {**inputs, "offset": mixed(generator, [uniform(generator, rows), edges])}


def _counts(inputs: Inputs) -> Tensor:
    index = systematic(inputs["log_weights"], inputs["offset"])
    counts = torch.zeros(inputs["log_weights"].shape, dtype=torch.float64)
    return counts.scatter_add_(-1, index, torch.ones_like(counts))


def _shares(inputs: Inputs) -> Tensor:
    return torch.softmax(inputs["log_weights"].double(), -1) * inputs["log_weights"].shape[-1]


# poses


def _draw_cloud(generator: torch.Generator) -> Inputs:
    """Modes far apart, particles of each within a millimetre and a hundredth of a radian, many of them coincident."""
    rows, modes, each = 8, 4, integer(generator, 1, 40)
    way = torch.arange(modes, dtype=torch.float64)[None, :, None] * torch.tensor((0.4, -0.3, 0.2), dtype=torch.float64)
    jitter = normal(generator, rows, modes, 3) * 0.01
    turn = so3.exp(rotation_vectors(generator, rows * modes)).reshape(rows, modes, 3, 3)
    centres = se3.make(turn, way + jitter)
    spread = torch.tensor([3e-4] * 3 + [3e-3] * 3, dtype=torch.float64)
    off = uniform(generator, rows, modes, each, 6, low=-1.0, high=1.0) * spread
    off = torch.where(uniform(generator, rows, modes, each, 1) < 0.3, 0.0, off)
    cloud = (centres[:, :, None] @ se3.exp(off)).flatten(1, 2)
    log = normal(generator, rows, modes * each) * choice(generator, (0.0, 1.0, 30.0))
    label = torch.arange(modes).repeat_interleave(each)
    mass = torch.zeros(rows, modes, dtype=torch.float64).index_add_(1, label, torch.softmax(log, -1))
    top = mass.topk(2, -1).values
    # where two modes weigh the same either may be the best
    return {"poses": cloud[top[:, 0] > top[:, 1] + 1e-3].float(), "log": log[top[:, 0] > top[:, 1] + 1e-3].float()}


def _mode(inputs: Inputs) -> Tensor:
    return PoseBelief.uniform(inputs["poses"]).reweighted(inputs["log"]).mode()


def _wanted_mode(inputs: Inputs) -> Tensor:
    modes, cloud = 4, se3.reproject(inputs["poses"].double())
    count = cloud.shape[1] // modes
    weights = torch.softmax(inputs["log"].double(), -1)
    best = weights.reshape(-1, modes, count).sum(-1).argmax(-1)
    own = torch.arange(modes).repeat_interleave(count)[None] == best[:, None]
    return se3.mean(cloud, torch.where(own, weights, 0.0))


def _draw_moves(generator: torch.Generator) -> Inputs:
    motions = poses(generator, ROWS * 20, 0.05).reshape(ROWS, 20, 4, 4)
    return {"motions": motions.float(), "start": poses(generator, ROWS).float()}


def _moved(inputs: Inputs) -> Tensor:
    belief = PoseBelief.uniform(inputs["start"][:, None])
    for motion in inputs["motions"].unbind(1):
        belief = belief.moved(motion)
    return belief.world_T_object[:, 0]


def _wanted_moved(inputs: Inputs) -> Tensor:
    total = se3.reproject(inputs["start"].double())
    for motion in inputs["motions"].double().unbind(1):
        total = se3.reproject(motion) @ total
    return total


# a belief's weights from poses and points, end to end


def _mug(dtype: torch.dtype) -> GridSDF:
    return here(_table(dtype))


@cache
def _table(dtype: torch.dtype) -> GridSDF:
    return GridSDF.from_sdf(Mug(), 0.002).to(dtype)


def _draw_scene(generator: torch.Generator) -> Inputs:
    """A mug at poses about the truth, 1 mm to 5 cm off; points on its surface and free ones about it."""
    count, size = 100, float(log_uniform(generator, 1, low=1e-3, high=0.05))
    truth = poses(generator, 1)[0]
    off = normal(generator, count, 6) * torch.tensor([size] * 3 + [10 * size] * 3, dtype=torch.float64)
    around = se3.reproject(truth @ se3.exp(off))
    box = torch.tensor([[-0.06, -0.06, -0.02], [0.09, 0.06, 0.12]], dtype=torch.float64)
    points = box[0] + (box[1] - box[0]) * uniform(generator, 600, 3)
    query = _mug(torch.float64)(points)
    near = points - query.distance[:, None] * query.gradient
    free = points[query.distance > 0.003]
    peakiness = float(log_uniform(generator, 1, low=1e-2, high=100.0))
    return {
        "poses": around.float(),
        "surface": se3.apply(truth, near[:200]).float(),
        "free": se3.apply(truth, free[:400]).float(),
        "peakiness": peakiness,
    }


def _weights_of_points(dtype: torch.dtype, inputs: Inputs) -> Tensor:
    """Weights and, behind them, the discrepancies."""
    world_T_object = inputs["poses"].to(dtype)
    parts = [(inputs["surface"], 2), (inputs["free"], 0)]
    surface, free = (Observation.of(points.to(dtype), semantics) for points, semantics in parts)
    cost = torch.zeros(len(world_T_object), dtype=dtype)
    module = Discrepancy(_mug(dtype), 0.12, free_scale=80.0, tolerance=0.001)
    for part in (surface, free):
        cost = cost + module(world_T_object, part)
    belief = replace(PoseBelief.uniform(world_T_object), discrepancy=cost)
    return torch.stack((belief.reweighted(boltzmann(cost, inputs["peakiness"])).weights, cost))[None]


def _scene_error(got: Tensor, wanted: Tensor, inputs: Inputs) -> Tensor:
    """Of the weights, in units of 1e-4; beyond a spread of 100, of 10 eps lambda times the greatest discrepancy."""
    cost = wanted[:, 1].double()
    spread = inputs["peakiness"] * (cost.amax(-1) - cost.amin(-1))
    most = 10 * EPS * inputs["peakiness"] * cost.amax(-1)
    return measures.absolute(got[:, 0], wanted[:, 0]) / torch.where(spread <= 100, 1e-4, most.clamp_min(1e-4))


def _scene_spread(inputs: Inputs) -> Tensor:
    cost = _weights_of_points(torch.float64, inputs)[:, 1]
    return inputs["peakiness"] * (cost.amax(-1) - cost.amin(-1))


def _enter() -> None:
    for sweep in (
        Sweep(
            "beliefs-normalised", _draw_weights,
            lambda i: _belief(i["log_weights"]).reweighted(i["log_weights"]).log_weights,
            lambda i: torch.log_softmax(i["log_weights"].double(), -1), _weights_error, 1.0, "of 10 eps",
            _spread, "spread, nats",
        ),
        Sweep(
            "beliefs-weights", partial(_draw_costs, True), _weigh, _wanted_weights,
            lambda got, wanted, i: measures.absolute(got, wanted), 1e-4, "nats", _cost_spread, "lambda times spread",
        ),
        Sweep(
            "beliefs-weights-beyond-100", partial(_draw_costs, False), _weigh, _wanted_weights, _beyond_error, 1.0,
            "of 10 eps lambda max", _cost_spread, "lambda times spread",
        ),
        Sweep(
            "beliefs-weights-of-points", _draw_scene, partial(_weights_of_points, torch.float32),
            partial(_weights_of_points, torch.float64), _scene_error, 1.0, "of 1e-4 (10 eps lambda max)",
            _scene_spread, "lambda times spread",
        ),
        Sweep(
            "beliefs-effective-size", _draw_weights,
            lambda i: _belief(i["log_weights"]).reweighted(i["log_weights"]).ess(), _wanted_ess, _ess_error, 1e-5,
            "relative", lambda i: torch.full((1,), float(i["log_weights"].shape[-1])), "particles",
        ),
        Sweep(
            "beliefs-resampling", _draw_comb, _counts, _shares,
            lambda got, wanted, i: measures.absolute(got, wanted), 1.0 + 1e-6, "copies",
            lambda i: torch.full((1,), float(i["log_weights"].shape[-1])), "particles",
        ),
        Sweep(
            "beliefs-mode", _draw_cloud, _mode, _wanted_mode, of_pose, 1e-5, "m, rad",
            lambda i: torch.full((1,), float(i["log"].shape[-1])), "particles",
        ),
        Sweep(
            "beliefs-moved", _draw_moves, _moved, _wanted_moved, of_pose, 1e-5, "m, rad",
            lambda i: torch.full((1,), 20.0), "motions",
        ),
    ):  # fmt: skip
        register(sweep)


_enter()
