"""The Gaussian process against one spelt out in numpy, and the choice of its data against slow searches."""

import importlib.util
import math
import sys

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from rumi.planning.implicit_surface import (
    Hyperparameters,
    Labelled,
    fit,
    labelled,
    next_to_nodes,
    predictive_mean,
    predictive_variance,
    spread_out,
)

needs_library = pytest.mark.skipif(importlib.util.find_spec("gpytorch") is None, reason="needs gpytorch")
SOME = Hyperparameters(0.08, 0.3, 0.002, 0.7)


def kernel(a: np.ndarray, b: np.ndarray, h: Hyperparameters) -> np.ndarray:
    r = math.sqrt(3) * np.linalg.norm(a[:, None] - b[None], axis=-1) / h.lengthscale_m
    return h.outputscale * (1 + r) * np.exp(-r)


def dense_variance(data: Labelled, h: Hyperparameters, points: Tensor) -> np.ndarray:
    x, at = data.points.numpy(), points.numpy()
    gram = kernel(x, x, h) + h.noise * np.eye(len(x))
    cross = kernel(at, x, h)
    return h.outputscale - np.einsum("vn,nv->v", cross, np.linalg.solve(gram, cross.T))


def dense_loss(data: Labelled, h: Hyperparameters) -> float:
    """Negative log marginal likelihood."""
    x, y = data.points.numpy(), data.labels.numpy() - h.mean
    gram = kernel(x, x, h) + h.noise * np.eye(len(x))
    return float(0.5 * (y @ np.linalg.solve(gram, y) + np.linalg.slogdet(gram)[1] + len(x) * math.log(2 * math.pi)))


def scattered(count: int, seed: int = 0) -> Tensor:
    random = torch.Generator().manual_seed(seed)
    return torch.rand(count, 3, generator=random, dtype=torch.float64) * torch.tensor([0.4, 0.3, 0.1]).double()


def ball(count: int = 60) -> Labelled:
    """Surface points of a ball, and free ones about it."""
    random = torch.Generator().manual_seed(1)
    ways = torch.nn.functional.normalize(torch.randn(count, 3, generator=random, dtype=torch.float64), dim=-1)
    points = torch.cat((0.05 * ways[: count // 2], 0.12 * ways[count // 2 :]))
    return Labelled(points, (torch.arange(count) >= count // 2).double())


@pytest.mark.parametrize("h", [SOME, Hyperparameters(0.5, 1.0, 1e-3, 0.0), Hyperparameters(0.01, 0.05, 0.1, 1.0)])
def test_variance_is_that_of_the_dense_process(h: Hyperparameters) -> None:
    data, at = ball(), scattered(700) - 0.1
    expected = dense_variance(data, h, at)
    np.testing.assert_allclose(predictive_variance(data, h, at).numpy(), expected, atol=1e-10)
    assert expected.min() < 0.9 * h.outputscale


@needs_library
def test_variance_is_the_librarys() -> None:
    import gpytorch

    from rumi.planning.implicit_surface import _exactly, _model

    data, at = ball(), scattered(50)
    with torch.no_grad(), _exactly(gpytorch):
        theirs = _model(gpytorch, data, SOME).eval()(at).variance
    # it adds a little to the diagonal
    torch.testing.assert_close(predictive_variance(data, SOME, at), theirs, atol=1e-7, rtol=0)


@given(st.integers(0, 10_000), st.integers(0, 30), st.floats(0.005, 2.0), st.floats(1e-4, 1.0))
def test_more_data_never_makes_less_sure(seed: int, count: int, length: float, noise: float) -> None:
    """The reduction of variance is 0 or more everywhere, and what is left is between 0 and the prior's."""
    h = Hyperparameters(length, 0.4, noise, 0.5)
    points, at = scattered(count + 1, seed), scattered(40, seed + 1)
    some = Labelled(points[:-1], torch.zeros(count, dtype=torch.float64))
    more = Labelled(points, torch.zeros(count + 1, dtype=torch.float64))
    before, after = predictive_variance(some, h, at), predictive_variance(more, h, at)
    assert float((before - after).min()) >= -1e-10
    assert float(after.min()) >= 0.0
    assert float(before.max()) <= 0.4


def test_variance_without_data_is_the_prior() -> None:
    none = Labelled(torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, dtype=torch.float64))
    assert bool((predictive_variance(none, SOME, scattered(5)) == SOME.outputscale).all())
    assert predictive_variance(ball(), SOME, torch.zeros(0, 3)).shape == (0,)


def test_variance_stands_points_that_coincide() -> None:
    twice = Labelled(ball().points.repeat(3, 1), ball().labels.repeat(3))
    variance = predictive_variance(twice, SOME._replace(noise=0.0, lengthscale_m=5.0), scattered(20))
    assert bool(variance.isfinite().all())


def drawn() -> Labelled:
    """Labels that a process has drawn."""
    truth, points = Hyperparameters(0.05, 0.3, 0.01, 0.5), scattered(120)
    gram = torch.from_numpy(kernel(points.numpy(), points.numpy(), truth)) + truth.noise * torch.eye(120).double()
    noise = torch.randn(120, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return Labelled(points, truth.mean + torch.linalg.cholesky(gram) @ noise)


@needs_library
class TestFit:
    def test_makes_the_data_likelier(self) -> None:
        data, start = ball(), Hyperparameters()
        found = fit(data, start, steps=50)
        assert dense_loss(data, found) < dense_loss(data, start) - 1.0

    def test_converges_to_where_no_neighbour_is_likelier(self) -> None:
        data = drawn()
        found = fit(data, steps=600)
        best = dense_loss(data, found)
        assert 0.02 < found.lengthscale_m < 0.12
        for name in ("lengthscale_m", "outputscale", "noise", "mean"):
            for factor in (0.8, 1.25):
                assert dense_loss(data, found._replace(**{name: factor * getattr(found, name)})) > best

    def test_goes_on_from_where_it_is_told(self) -> None:
        data, good = ball(), Hyperparameters(0.05, 0.3, 1e-3, 0.8)
        assert fit(data, good, steps=0) == good
        assert dense_loss(data, fit(data, good, steps=5)) < dense_loss(data, fit(data, steps=5))

    def test_lengthscale_keeps_to_its_bound(self) -> None:
        data = ball()
        free = fit(data, steps=50)
        assert fit(data, steps=50, least_lengthscale_m=0.01) != free
        bound = 1.5 * free.lengthscale_m
        held = fit(data, Hyperparameters(0.01), steps=50, least_lengthscale_m=bound)
        assert bound <= held.lengthscale_m < 1.5 * bound

    def test_ends_where_the_likelihood_is_flat(self) -> None:
        data = drawn()
        good = fit(data, steps=300)
        assert fit(data, good, tolerance=0.05) == pytest.approx(good)
        assert fit(data, good) != pytest.approx(good)
        assert fit(data, tolerance=0.05) != pytest.approx(Hyperparameters())

    def test_is_the_same_each_time(self) -> None:
        before = torch.get_rng_state()
        assert fit(ball(), steps=5) == fit(ball(), steps=5)
        assert torch.equal(torch.get_rng_state(), before)

    @pytest.mark.parametrize("count", [0, 1, 30])
    @pytest.mark.parametrize("label", [0.0, 1.0])
    def test_labels_that_are_all_alike_change_nothing(self, count: int, label: float) -> None:
        data = Labelled(scattered(30)[:count], torch.full((count,), label, dtype=torch.float64))
        assert fit(data, SOME) == SOME

    @pytest.mark.parametrize("count", [2, 3, 30])
    def test_stands_next_to_no_contrast(self, count: int) -> None:
        points = scattered(30)[:count]
        labels = (torch.arange(count) == 0).double()
        found = fit(Labelled(points, labels), steps=300)
        assert all(math.isfinite(value) for value in found)
        assert found.lengthscale_m <= 0.55
        assert float(predictive_variance(Labelled(points, labels), found, scattered(9)).amax()) > 0.0

    def test_works_while_gradients_are_off(self) -> None:
        with torch.no_grad():
            assert fit(ball(), steps=3) == fit(ball(), steps=3) != Hyperparameters()


def test_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gpytorch", None)
    with pytest.raises(ModuleNotFoundError, match=r"needs gpytorch.*pip install -e '.*\[baselines\]'"):
        fit(ball())


def test_thinning_keeps_the_point_next_to_each_node() -> None:
    points, spacing = scattered(400) - 0.1, 0.07
    best: dict[tuple[int, ...], tuple[float, int]] = {}
    for index, point in enumerate(points.tolist()):
        node = tuple(math.floor(value / spacing + 0.5) for value in point)
        away = math.dist(point, [number * spacing for number in node])
        best[node] = min(best.get(node, (math.inf, -1)), (away, index))
    kept = next_to_nodes(points, spacing)
    assert {tuple(p) for p in kept.tolist()} == {tuple(points[index].tolist()) for _, index in best.values()}
    assert torch.equal(next_to_nodes(kept, spacing), kept)
    assert next_to_nodes(points[:0], spacing).shape == (0, 3)


@pytest.mark.parametrize("side", [0.8, 0.6, 0.02])
def test_thinning_covers_a_box_from_corner_to_corner(side: float) -> None:
    """No point is farther than about half a spacing along each axis, and the corners stay."""
    axis = 0.02 * torch.arange(round(side / 0.02) + 1)
    square = torch.cartesian_prod(axis, axis - 0.4, torch.full((1,), 0.045))
    bounds = torch.stack((square.amin(0), square.amax(0)))
    chosen = next_to_nodes(square, 0.14, bounds)
    assert len(chosen) == (math.ceil(side / 0.14) + 1) ** 2
    nearest = (square[:, None] - chosen).abs().amax(-1).amin(-1)
    assert float(nearest.max()) <= 0.07 + 0.01
    for corner in (bounds[0], bounds[1]):
        assert float((chosen - corner).norm(dim=-1).min()) < 1e-6


def test_spread_out_points_cover_the_others() -> None:
    """Farthest-point sampling covers at most twice as badly as the best choice; every pair is that far apart."""
    points = scattered(300)
    chosen = spread_out(points, 12)
    assert chosen.shape == (12, 3)
    radius = torch.cdist(points, chosen).amin(-1).max()
    apart = torch.cdist(chosen, chosen) + torch.eye(12)
    assert float(apart.min()) >= float(radius)
    assert torch.equal(spread_out(points, 300), points)
    assert spread_out(points, 0).shape == (0, 3)
    assert len(spread_out(points[:1].repeat(5, 1), 3)) == 3


@pytest.mark.parametrize(
    ("surface", "free", "expected"), [(200, 40, (60, 40)), (200, 90, (25, 75)), (20, 300, (20, 80))]
)
def test_cap_leaves_each_class_its_share(surface: int, free: int, expected: tuple[int, int]) -> None:
    """Free points here are far apart."""
    apart = torch.stack((torch.arange(float(free)), torch.zeros(free), torch.zeros(free)), -1) + 0.5
    data = labelled(scattered(surface).float(), apart, 100)
    assert (int((data.labels == 0).sum()), int((data.labels == 1).sum())) == expected
    assert data.points.dtype == data.labels.dtype == torch.float64
    whole = labelled(scattered(surface).float(), apart, None)
    assert len(whole.points) == surface + free


def test_the_mean_is_that_of_a_dense_solve():
    data, at = ball(), scattered(40)
    x, y = data.points.numpy(), data.labels.numpy() - SOME.mean
    gram = kernel(x, x, SOME) + SOME.noise * np.eye(len(x))
    expected = SOME.mean + kernel(at.numpy(), x, SOME) @ np.linalg.solve(gram, y)
    np.testing.assert_allclose(predictive_mean(data, SOME, at).numpy(), expected, atol=1e-10)
    # without data it is the constant, and labels without noise come back
    nothing = Labelled(torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, dtype=torch.float64))
    assert predictive_mean(nothing, SOME, at).tolist() == [SOME.mean] * len(at)
    exact = predictive_mean(data, SOME._replace(noise=0.0), data.points)
    np.testing.assert_allclose(exact.numpy(), data.labels.numpy(), atol=2e-3)
