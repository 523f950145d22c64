"""Entropy of weighted sets: exact on lattices, golden numbers, closed forms, loops spelt out."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from rumi.information.entropy import (
    NeighbourEntropy,
    SharedSupport,
    SpatialEntropy,
    weights_entropy,
)
from rumi.information.neighbours import StateMetric, neighbours, unique_states
from sdf import backend
from tests.fixtures.entropies import ENTROPIES, entropies

DOUBLE = {"dtype": torch.float64}
PLANAR = StateMetric((0.06, 0.06, 0.5), (False, False, True))


# every test of this file holds for the plain and for the compiled version
pytestmark = pytest.mark.usefixtures("version")


def uniform_weights(count: int) -> Tensor:
    return torch.zeros(count, **DOUBLE)


def turns(count: int) -> Tensor:
    """`count` angles that divide the circle."""
    return torch.arange(count, **DOUBLE) * (2.0 * math.pi / count) - 3.0


def lattice(axes: list[Tensor]) -> Tensor:
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(axes))


@pytest.mark.parametrize("rho", [2, 3, 5, 6])
@pytest.mark.parametrize("spacing", [1e-3, 0.1, 7.0])
def test_exact_on_a_line(rho: int, spacing: float) -> None:
    """N points a spacing apart stand for N spacings, at the ends too."""
    x = torch.arange(40, **DOUBLE)[:, None] * spacing
    found = SpatialEntropy(SharedSupport(StateMetric.euclidean(1), rho))(x, uniform_weights(40))
    assert float(found) == pytest.approx(math.log(40 * spacing), abs=1e-12)


@pytest.mark.parametrize(("dims", "rho"), [(1, 3), (1, 5), (2, 9), (3, 27)])
def test_exact_on_a_torus(dims: int, rho: int) -> None:
    """Angles on a lattice without ends fill (2 pi)^D."""
    x = lattice([turns(8)] * dims)
    metric = StateMetric((1.0,) * dims, (True,) * dims)
    support = SharedSupport(metric, rho)
    found = SpatialEntropy(support)(x, uniform_weights(len(x)))
    assert float(found) == pytest.approx(dims * math.log(2.0 * math.pi), abs=1e-12)
    sides = support(x, uniform_weights(len(x))).sides
    torch.testing.assert_close(sides, torch.full((dims,), math.pi / 4, **DOUBLE), atol=1e-12, rtol=0)


def test_metres_and_radians_on_a_lattice() -> None:
    """Spacings of one unit each in the metric; the ends' boxes are as wide in 1 of 5 rows: neighbours by the metric."""
    metric = StateMetric((0.05, 0.2), (True, True))
    x = lattice([turns(60), turns(15)])
    found = SharedSupport(metric, 9)(x, uniform_weights(len(x)))
    torch.testing.assert_close(
        found.sides, torch.tensor([2 * math.pi / 60, 2 * math.pi / 15], **DOUBLE), atol=1e-12, rtol=0
    )


@pytest.mark.parametrize(
    "name", ["ent.2d.rho5.incl_self", "ent.2d.rho5.excl_self", "ent.2d.rho3.excl_self", "ent.3d.rho5.excl_self"]
)
def test_golden_supports(golden: Callable[[str], dict[str, Any]], name: str) -> None:
    case = golden(name)
    x, log = torch.tensor(case["inputs"]["x"], **DOUBLE), torch.tensor(case["inputs"]["w"], **DOUBLE).log()
    rho, own = case["inputs"]["rho"], "incl" in name
    metric = StateMetric.euclidean(x.shape[1])
    support = SharedSupport(metric, rho, include_self=own)
    boxes = neighbours(x, unique_states(x, log, metric), metric, rho, include_self=own)
    expected, exact = case["expected"], {"atol": case["atol"], "rtol": 0}
    torch.testing.assert_close(boxes.sides.mean(0), torch.tensor(expected["mean_side"], **DOUBLE), **exact)
    found = support(x, log)
    torch.testing.assert_close(found.sides, torch.tensor(expected["support_side"], **DOUBLE), **exact)
    assert float(found.log_volume) == pytest.approx(expected["logV"], abs=case["atol"])
    assert float(SpatialEntropy(support)(x, log)) == pytest.approx(expected["H"], abs=case["atol"])


def test_golden_weights(golden: Callable[[str], dict[str, Any]]) -> None:
    case = golden("ent.weight")
    for weights, expected in zip(case["inputs"]["w"], case["expected"]["H_w"], strict=True):
        log = torch.tensor(weights, **DOUBLE).log()
        assert float(weights_entropy(log)) == pytest.approx(expected, abs=case["atol"])


def test_golden_cell_of_a_lattice(golden: Callable[[str], dict[str, Any]]) -> None:
    """Two or three points a side: the box over what a lattice cell is."""
    case = golden("ent.grid")
    for box, rho, dims, cell in zip(
        *(case["inputs"][k] for k in ("box_side", "rho", "d")), case["expected"]["cell_side"], strict=True
    ):
        points = round(rho ** (1 / dims))
        x = lattice([torch.linspace(0, box, points, **DOUBLE)] * dims)
        found = SharedSupport(StateMetric.euclidean(dims), rho)(x, uniform_weights(rho))
        torch.testing.assert_close(found.sides, torch.full((dims,), cell, **DOUBLE), atol=case["atol"], rtol=0)


def test_golden_duplicates(golden: Callable[[str], dict[str, Any]]) -> None:
    case = golden("ent.dedupe")
    x, log = torch.tensor(case["inputs"]["x"], **DOUBLE), torch.tensor(case["inputs"]["w"], **DOUBLE).log()
    unique = unique_states(x, log, StateMetric.euclidean(2))
    assert int(unique.states) == len(case["expected"]["unique"])
    found = {
        tuple(s): float(w.exp())
        for s, w in zip(x[unique.first].tolist(), unique.log_weights[unique.first], strict=True)
    }
    for state, weight in zip(case["expected"]["unique"], case["expected"]["w"], strict=True):
        assert found[tuple(state)] == pytest.approx(weight, abs=case["atol"])
    assert float(weights_entropy(unique.log_weights)) == pytest.approx(case["expected"]["H_w"], abs=1e-12)
    assert float(weights_entropy(log)) == pytest.approx(case["expected"]["H_w_raw"], abs=1e-12)


def test_golden_mixture(golden: Callable[[str], dict[str, Any]]) -> None:
    case = golden("ent.mixture")
    log = torch.tensor(case["inputs"]["w"], **DOUBLE).log()
    bound = float(weights_entropy(log)) + sum(math.log(s) for s in case["inputs"]["side"])
    assert bound == pytest.approx(case["expected"]["H_bound"], abs=case["atol"])
    assert case["expected"]["H_exact"] <= bound


def reference(x: Tensor, w: Tensor, metric: StateMetric, rho: int) -> tuple[float, float]:
    """Spatial and neighbour entropy, one state after the other."""
    states: dict[tuple[float, ...], float] = {}
    for state, weight in zip(x.tolist(), w.tolist(), strict=True):
        if weight > 0:
            states[tuple(state)] = states.get(tuple(state), 0.0) + weight
    points, weights = list(states), list(states.values())

    def apart(a: tuple[float, ...], b: tuple[float, ...]) -> list[float]:
        return [
            math.remainder(p - q, 2 * math.pi) if angle else p - q
            for p, q, angle in zip(a, b, metric.angles, strict=True)
        ]

    def length(d: list[float]) -> float:
        return math.hypot(*(v / s for v, s in zip(d, metric.scales, strict=True)))

    total = [0.0] * metric.dims
    knn = 0.0
    size = 1 / sum(v * v for v in weights)
    k = rho - 1
    for i, here in enumerate(points):
        near = sorted(((length(apart(p, here)), j) for j, p in enumerate(points)))[:rho]
        for axis in range(metric.dims):
            places = [apart(points[j], here)[axis] for _, j in near]
            total[axis] += max(places) - min(places)
        share = sum(weights[j] for _, j in near if j != i) / (1 - weights[i])
        knn += weights[i] * (metric.dims * math.log(near[-1][0]) - math.log(share))
    scale = rho ** (1 / metric.dims) - 1
    sides = [t / len(points) / scale for t in total]
    log_volume = sum(math.log(s) for s in sides)
    spatial = -sum(v * math.log(v) for v in weights) + log_volume
    digamma = [float(torch.digamma(torch.tensor(v, **DOUBLE))) for v in (size, float(k))]
    ball = 0.5 * metric.dims * math.log(math.pi) - math.lgamma(0.5 * metric.dims + 1)
    knn += digamma[0] - math.log(size - 1) + math.log(k) - digamma[1] + ball + sum(map(math.log, metric.scales))
    return spatial, knn


@pytest.mark.parametrize("duplicates", [False, True])
def test_all_estimators_against_loops(duplicates: bool, generator: torch.Generator) -> None:
    x = torch.randn(40, 3, generator=generator, **DOUBLE) * torch.tensor([0.05, 0.08, 2.0])
    w = torch.rand(40, generator=generator, **DOUBLE)
    w[5] = 0.0
    if duplicates:
        x = x[torch.randint(0, 25, (40,), generator=generator)]
    w = w / w.sum()
    support = SharedSupport(PLANAR, 5)
    found = [float(entropy(x, w.log())) for entropy in entropies(support).values()]
    assert found == pytest.approx(list(reference(x, w, PLANAR, 5)), abs=1e-9)


@given(st.floats(0.01, 100.0), st.integers(1, 3))
def test_scale_equivariance(factor: float, dims: int) -> None:
    """H(a x) = H(x) + D log a, with units that are scaled along."""
    generator = torch.Generator().manual_seed(dims)
    x, log = torch.randn(60, dims, generator=generator, **DOUBLE), torch.randn(60, generator=generator, **DOUBLE)
    for name in ENTROPIES:
        plain = entropies(SharedSupport(StateMetric.euclidean(dims)))[name](x, log)
        scaled = entropies(SharedSupport(StateMetric((factor,) * dims, (False,) * dims)))[name](factor * x, log)
        assert float(scaled - plain) == pytest.approx(dims * math.log(factor), abs=1e-9)


def test_kozachenko_leonenko_is_theirs_for_equal_weights(generator: torch.Generator) -> None:
    """psi(N) - psi(k) + log c_D + D mean log distance."""
    count, dims, k = 200, 2, 4
    x = torch.randn(count, dims, generator=generator, **DOUBLE)
    distance = torch.cdist(x, x).sort(-1).values[:, k]
    expected = (
        torch.digamma(torch.tensor(float(count), **DOUBLE))
        - torch.digamma(torch.tensor(float(k), **DOUBLE))
        + math.log(math.pi)
        + dims * distance.log().mean()
    )
    found = NeighbourEntropy(StateMetric.euclidean(dims), k)(x, uniform_weights(count))
    assert float(found) == pytest.approx(float(expected), abs=1e-9)


@pytest.mark.parametrize(("dims", "biases"), [(1, (-0.26, -0.09)), (2, (0.15, 0.06)), (3, (1.12, 0.77))])
def test_bias_is_what_prototypes_found(dims: int, biases: tuple[float, float], generator: torch.Generator) -> None:
    """Uniform and Gaussian, N = 100, rho = 5; the mean of 200 sets of standard deviation 0.1."""
    support = SharedSupport(StateMetric.euclidean(dims))
    uniform = torch.rand(200, 100, dims, generator=generator, **DOUBLE)
    gaussian = torch.randn(200, 100, dims, generator=generator, **DOUBLE)
    truth = 0.5 * dims * math.log(2 * math.pi * math.e)
    estimate, log = SpatialEntropy(support), uniform_weights(100)
    assert float(estimate(uniform, log).mean()) == pytest.approx(biases[0], abs=0.04)
    assert float(estimate(gaussian, log).mean()) - truth == pytest.approx(biases[1], abs=0.04)


def test_refusals(no_shape_check: None) -> None:
    with pytest.raises(ValueError, match="scales above 0"):
        StateMetric((0.0,), (False,))
    with pytest.raises(ValueError, match="as many scales"):
        StateMetric((1.0,), (False, True))
    with pytest.raises(ValueError, match="neighbours"):
        SharedSupport(PLANAR, 1)
    with pytest.raises(ValueError, match="floor above 0"):
        SharedSupport(PLANAR, floor=0.0)
    with pytest.raises(ValueError, match="one floor"):
        SharedSupport(PLANAR, floor=(1.0, 1.0))
    with pytest.raises(ValueError, match="states"):
        SharedSupport(PLANAR)(torch.zeros(5, 2), torch.zeros(5))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("own", [True, False])
@pytest.mark.parametrize("shape", [(6, 40), (3, 1), (0, 10), (4, 3)])
def test_versions_agree(shape: tuple[int, int], own: bool, dtype: torch.dtype, generator: torch.Generator) -> None:
    x = (torch.randn(*shape, 3, generator=generator, **DOUBLE) * torch.tensor([0.05, 0.08, 2.0])).to(dtype)
    x[1:2, : shape[1] // 2] = x[1:2, shape[1] - shape[1] // 2 :]
    log = torch.randn(*shape, generator=generator, **DOUBLE).to(dtype)
    log[..., ::7] = -math.inf
    log[..., -1] = 0.0
    with backend.force("torch"):
        plain = unique_states(x, log, PLANAR)
        around = neighbours(x, plain, PLANAR, 5, include_self=own)
    found = unique_states(x, log, PLANAR)
    assert torch.equal(found.first, plain.first)
    assert torch.equal(found.states, plain.states)
    torch.testing.assert_close(found.log_weights, plain.log_weights)
    for a, b in zip(neighbours(x, found, PLANAR, 5, include_self=own), around, strict=True):
        torch.testing.assert_close(a, b)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_neighbours_of_next_to_no_weight_share_what_is_left(dtype: torch.dtype) -> None:
    estimate = NeighbourEntropy(StateMetric.euclidean(2), 1)
    states = torch.tensor([[0.0, 0.0], [0.3, 0.4]], dtype=dtype)
    # the one neighbour has all that the state itself has not, however little that is
    pairs = [estimate(states, torch.tensor([0.0, log_weight], dtype=dtype)) for log_weight in (-30.0, -80.0, -600.0)]
    wanted = 2 * math.log(0.5) + math.log(math.pi) - math.log(1e-6)
    assert [float(found) for found in pairs] == pytest.approx([wanted] * 3, abs=1e-3)


@pytest.mark.parametrize("version", ["torch"], indirect=True)
def test_the_slope_of_a_weight_of_nothing_is_that_of_the_others() -> None:
    log_weights = torch.tensor([0.3, -math.inf, 1.2, 0.0], **DOUBLE).requires_grad_()
    (slope,) = torch.autograd.grad(weights_entropy(log_weights), log_weights)
    few = log_weights.detach()[[0, 2, 3]].requires_grad_()
    (expected,) = torch.autograd.grad(weights_entropy(few), few)
    torch.testing.assert_close(slope[[0, 2, 3]], expected)
    assert float(slope[1]) == 0.0
