"""Gaussian-process implicit surface: a zero level set with a variance at each point (RUMI, V-H)."""

import math
from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from sdf.check import check_shape
from sdf.extras import optional
from sdf.voxel_grid import lattice_keys

# points whose covariances with the data are held at once: few enough for the processor's cache
_CHUNK = 512
_LEAST_SCALE = 1e-4
# the library's own bound: with it, covariances of twice the same point have a factor
_LEAST_NOISE = 1e-4


class Labelled(NamedTuple):
    """Training points of a Gaussian process, with their labels.

    Attributes:
        points: (N, 3), metres, float64.
        labels: (N,), 0 on the surface and 1 in free space.
    """

    points: Float[Tensor, "N 3"]
    labels: Float[Tensor, "N"]


class Hyperparameters(NamedTuple):
    """Of a process with a constant mean and a Matern kernel of smoothness 1.5.

    Attributes:
        lengthscale_m: of the kernel, metres.
        outputscale: variance of the process far from all data.
        noise: variance of the labels' noise.
        mean: constant mean of the labels.
    """

    lengthscale_m: float = 0.2
    outputscale: float = 0.2
    noise: float = 0.01
    mean: float = 0.5


def library() -> ModuleType:
    """The library of Gaussian processes.

    Raises:
        ModuleNotFoundError: it is not installed.
    """
    library: ModuleType = optional("gpytorch", "The method gpvr")
    return library


def prepare() -> None:
    """Load all that a fit needs, which takes seconds the first time: not in the midst of a plan.

    Raises:
        ModuleNotFoundError: the library is not installed.
    """
    fit(Labelled(torch.eye(2, 3, dtype=torch.float64), torch.arange(2.0, dtype=torch.float64)), steps=1)


def labelled(surface: Float[Tensor, "S 3"], free: Float[Tensor, "F 3"], most: int | None = None) -> Labelled:
    """Data of surface and free points.

    Args:
        surface: label 0.
        free: label 1, thin already (`next_to_nodes`).
        most: points in all; None keeps every one. Free points come first, as long as surface ones have a quarter; of
            each class those stay that are farthest from each other.
    """
    if most is not None:
        surface = spread_out(surface, max(most - len(free), most // 4))
        free = spread_out(free, most - len(surface))
    points = torch.cat((surface, free)).double()
    return Labelled(points, (torch.arange(len(points), device=points.device) >= len(surface)).double())


def next_to_nodes(
    points: Float[Tensor, "N 3"], spacing: float, bounds: Float[Tensor, "2 3"] | None = None
) -> Float[Tensor, "M 3"]:
    """One point for each lattice node that has any within half a spacing along every axis: the nearest.

    Args:
        points: metres.
        spacing: of the lattice, metres.
        bounds: box from corner to corner of which the lattice goes, with a spacing that is a bit less where it does
            not divide the box. None for a lattice through the world's origin.
    """
    check_shape("points", points, "(N, 3)", last=(3,))
    if len(points) == 0:
        return points
    low, pitch = points.new_zeros(3), points.new_full((3,), spacing)
    if bounds is not None:
        low, extent = bounds[0].to(points), (bounds[1] - bounds[0]).to(points)
        pitch = torch.where(extent > 0, extent / torch.ceil(extent / spacing - 1e-4).clamp_min(1.0), pitch)
    # cells about the nodes, as a lattice of spacing 1 has them
    shifted = (points - low) / pitch + 0.5
    away = ((shifted - torch.floor(shifted) - 0.5) * pitch).norm(dim=-1)
    keys, cell = torch.unique(lattice_keys(shifted, 1.0), return_inverse=True)
    least = away.new_full((len(keys),), torch.inf).scatter_reduce_(0, cell, away, "amin")
    nearest = torch.nonzero(away == least[cell]).squeeze(-1)
    # of points as near as each other, the first
    first = nearest.new_full((len(keys),), len(points)).scatter_reduce_(0, cell[nearest], nearest, "amin")
    return points[first]


def spread_out(points: Float[Tensor, "N 3"], count: int) -> Float[Tensor, "M 3"]:
    """At most `count` of the points, each next one the farthest from those chosen; the first one starts."""
    if len(points) <= count:
        return points
    chosen = [0] if count > 0 else []
    away = (points - points[0]).norm(dim=-1)
    for _ in range(count - 1):
        chosen.append(int(away.argmax()))
        away = torch.minimum(away, (points - points[chosen[-1]]).norm(dim=-1))
    return points[chosen]


def fit(
    data: Labelled,
    start: Hyperparameters | None = None,
    *,
    steps: int = 50,
    learning_rate: float = 0.1,
    least_lengthscale_m: float = 0.0,
    tolerance: float = 0.0,
    should_stop: Callable[[], bool] | None = None,
) -> Hyperparameters:
    """Hyperparameters after some steps of Adam on the exact marginal likelihood.

    Labels that are all alike say nothing of the scales on which they change, and leave the start as it is: fitted, the
    process would flatten out, and be as sure between the points as at them.

    Args:
        data: of any number of points.
        start: where to start, the last fit's for a warm start.
        steps: of the optimiser.
        learning_rate: of the unconstrained parameters.
        least_lengthscale_m: lower bound of the lengthscale.
        tolerance: gradient of the likelihood a point, nats, in every unconstrained parameter, below which no further
            step is taken; 0 takes all.
        should_stop: asked after each step; on True the fit so far is the result.
    """
    start = start or Hyperparameters()
    start = start._replace(lengthscale_m=max(start.lengthscale_m, 1.01 * least_lengthscale_m))
    if steps == 0 or not bool((data.labels != data.labels[:1]).any()):
        return start
    gp = library()
    with torch.enable_grad(), _exactly(gp):
        model = _model(gp, data, start, least_lengthscale_m).train()
        likelihood = gp.mlls.ExactMarginalLogLikelihood(model.likelihood, model)
        optimiser = torch.optim.Adam(model.parameters(), lr=learning_rate)
        for _ in range(steps):
            optimiser.zero_grad()
            loss = -likelihood(model(data.points), data.labels)
            loss.backward()
            if max(float(part.grad.abs().max()) for part in model.parameters()) < tolerance:
                break
            optimiser.step()
            if should_stop is not None and should_stop():
                break
    kernel = model.covar_module
    values = (kernel.base_kernel.lengthscale, kernel.outputscale, model.likelihood.noise, model.mean_module.constant)
    found = Hyperparameters(*(value.item() for value in values))
    if not bool(torch.tensor(found).isfinite().all()):
        return start
    widest = float((data.points.amax(0) - data.points.amin(0)).norm())
    least = max(least_lengthscale_m, 1e-3)
    length = min(max(found.lengthscale_m, least), max(widest, least))
    return found._replace(lengthscale_m=length, outputscale=max(found.outputscale, _LEAST_SCALE))


@torch.no_grad()
def predictive_variance(
    data: Labelled, hyperparameters: Hyperparameters, points: Float[Tensor, "V 3"]
) -> Float[Tensor, "V"]:
    """Variance of the process at some points given the data, float64: 0 or more, at most the outputscale.

    `k(x, x) - k(x, X) (k(X, X) + noise)^-1 k(X, x)` by one Cholesky factor, and one triangular solve a point.
    """
    scale, places = hyperparameters.outputscale, points.double()
    if len(data.points) == 0:
        return places.new_full((len(points),), scale)
    covariance = _matern(data.points, data.points, hyperparameters)
    covariance.diagonal().add_(max(hyperparameters.noise, _LEAST_NOISE))
    factor = torch.linalg.cholesky(covariance)
    known = [
        torch.linalg.solve_triangular(factor, _matern(data.points, part, hyperparameters), upper=False).square().sum(0)
        for part in places.split(_CHUNK)
    ]
    return (scale - torch.cat(known)).clamp(0.0, scale) if known else places.new_zeros(0)


def predictive_mean(
    data: Labelled, hyperparameters: Hyperparameters, points: Float[Tensor, "V 3"]
) -> Float[Tensor, "V"]:
    """Mean of the process at some points given the data, float64: 0 is the implicit surface, 1 free space.

    `m + k(x, X) (k(X, X) + noise)^-1 (y - m)`; the constant m far from all data.
    """
    places = points.double()
    if len(data.points) == 0:
        return places.new_full((len(points),), hyperparameters.mean)
    covariance = _matern(data.points, data.points, hyperparameters)
    covariance.diagonal().add_(max(hyperparameters.noise, _LEAST_NOISE))
    factor = torch.linalg.cholesky(covariance)
    weights = torch.cholesky_solve((data.labels - hyperparameters.mean)[:, None], factor)
    parts = [_matern(part, data.points, hyperparameters) @ weights for part in places.split(_CHUNK)]
    return hyperparameters.mean + torch.cat(parts)[:, 0] if parts else places.new_zeros(0)


def _matern(
    first: Float[Tensor, "N 3"], second: Float[Tensor, "M 3"], hyperparameters: Hyperparameters
) -> Float[Tensor, "N M"]:
    """Matern covariances of smoothness 1.5."""
    # not by way of the scalar product, which loses the digits of points a millimetre apart
    away = torch.cdist(first, second, compute_mode="donot_use_mm_for_euclid_dist")
    away *= math.sqrt(3.0) / hyperparameters.lengthscale_m
    return hyperparameters.outputscale * (1.0 + away) * torch.exp(-away)


def _exactly(gp: ModuleType) -> Any:  # noqa: ANN401  (a context of the library)
    """Cholesky factors instead of iterations, whatever the number of points."""
    return gp.settings.fast_computations(covar_root_decomposition=False, log_prob=False, solves=False)


def _model(gp: ModuleType, data: Labelled, start: Hyperparameters, least_lengthscale_m: float = 0.0) -> Any:  # noqa: ANN401  (of the library)
    """The library's exact process, float64, at given hyperparameters."""
    longer = gp.constraints.GreaterThan(least_lengthscale_m)

    class Surface(gp.models.ExactGP):  # type: ignore[name-defined]
        def __init__(self) -> None:
            super().__init__(data.points, data.labels, gp.likelihoods.GaussianLikelihood())
            self.mean_module = gp.means.ConstantMean()
            self.covar_module = gp.kernels.ScaleKernel(gp.kernels.MaternKernel(1.5, lengthscale_constraint=longer))

        def forward(self, points: Tensor) -> object:
            return gp.distributions.MultivariateNormal(self.mean_module(points), self.covar_module(points))

    model = Surface().to(data.points)
    model.covar_module.base_kernel.lengthscale = start.lengthscale_m
    model.covar_module.outputscale = start.outputscale
    model.likelihood.noise = max(start.noise, 1.001 * _LEAST_NOISE)
    model.mean_module.constant.data.fill_(start.mean)
    return model
