"""Priors over push parameters by the real pushes of some shapes, as they would be without the others.

All that a prior has is found from the shapes that it is made of: each set's own fit (of that set alone), the scatter
of the fits, the residual they leave, and the scales of the shifts between tracked tool and object. The residual's
factor is chosen by leaving out each of these shapes in turn. How much an object's own pushes weigh is the library's own
number, chosen on the long ways of another object (`scripts.long_pushes`).
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.push_density import PushResidual
from rumi.dynamics.push_posterior import PushPosterior
from rumi.dynamics.push_registration import Registration
from scripts.bench.real_pushes import PushSet, body_of, predicted, push_set

Parameters = tuple[float, ...]

_MIDDLE = (math.log(0.3), *[0.0] * 7)
_WIDE = (1.0, 0.9, 2.4, 4.6, 0.08, 0.08, 0.12, 0.12)
"""Prior of fits to whole sets."""
_ROUND = PushResidual((1e-4, 1e-4, 1e-4), (0.05, 0.05, 0.05), 2.0, 1.0, 0.0)
"""Residual of fits to whole sets: round numbers, all pushes at their full weight."""
_SHIFT_TAILS = 4.0  # degrees of freedom, as `Registration` has them
_OTHER_TOOLS = (0.6, 2.5)
"""Greatest friction of a tool in the simulator, and the deviations of the library's prior at which it lies."""


_HELD = (0.9, 0.82)  # of regions of 90 %: what they are to hold of all shapes, and of the least
FACTORS = (0.7, 0.8, 0.9, 1.0, 1.1)
"""Of the residual's scales, which the sets' own fits leave: particles that differ are doubt too."""


def fit(own: PushSet, *, evaluations: int = 500) -> Parameters:
    """Parameters of greatest posterior density, by all pushes of a set and a wide prior (Nelder-Mead)."""
    from scipy.optimize import minimize

    wide = PushPosterior.prior(256, mean=_MIDDLE, deviation=[0.5 * part for part in _WIDE], residual=_ROUND)
    pushes = own.observed(torch.arange(len(own.start)))
    registered = Registration().learnt(pushes, own.body)
    wide = replace(wide, deviation=_WIDE, registration=registered, white=None)
    few = pushes[:: max(1, len(pushes) // 40)]
    like = wide.log_likelihood(few, own.body)
    start, deviation = wide.parameters[like.argmax()].numpy(), np.array(wide.deviation)
    full = replace(wide, pushes=tuple(pushes))

    def cost(parameters: np.ndarray) -> float:
        particle = torch.tensor(np.concatenate((parameters, np.zeros(6))))[None]
        return -float(full._log_target(particle, own.body))

    simplex = np.vstack([start] + [start + 0.2 * row for row in np.diag(deviation)])
    found = minimize(cost, start, method="Nelder-Mead", options={"maxfev": evaluations, "initial_simplex": simplex})
    return tuple(float(part) for part in found.x)


def prior_of(fits: Mapping[str, Parameters], factor: float, count: int = 256) -> PushPosterior:
    """Prior, residual and registration by the fits of some sets; what has a sign that a mirror changes is about 0.

    How elongation shapes the limit surface is weighed by how elongated the shapes are. Deviations are those that the
    next shape is off a mean of so few: the scatter times sqrt((n + 1) / (n - 1)) for n shapes.
    """
    rows = torch.tensor(list(fits.values()), dtype=torch.float64)
    shapes = [name.split()[1] for name in fits]
    weights = torch.ones_like(rows)
    weights[:, 3] = torch.stack([body_of(shape).support.elongation.square().sum() for shape in shapes])
    weights = weights / weights.sum(0)
    each = torch.stack([weights[[own == shape for own in shapes]].sum(0) for shape in dict.fromkeys(shapes)])
    number = each.square().sum(0).reciprocal()
    mean = (weights * rows).sum(0)
    mean[4:] = 0.0
    next_off = ((number + 1.0) / (number - 1.0)).sqrt()
    next_off[4:] = 1.0  # about a mean that is known
    deviation = next_off * (weights * (rows - mean).square()).sum(0).sqrt()
    left = residual_of(tuple(fits.items()))
    (a, b, c), (d, e, f), by = left.floor_m, left.share, factor
    residual = PushResidual(
        (by * a, by * b, by * c), (by * d, by * e, by * f), left.tails, spread=scale_spread(tuple(fits.items()))
    )
    return PushPosterior.prior(
        count,
        mean=mean.tolist(),
        deviation=deviation.tolist(),
        residual=residual,
        registration=Registration(shift_scales(tuple(fits))),
    )


def without(fits: Mapping[str, Parameters], shapes: Collection[str], surface: str = "") -> dict[str, Parameters]:
    """The fits of all other shapes, on all other surfaces."""
    own = {name: name.split() for name in fits}
    return {name: fits[name] for name, (on, shape) in own.items() if shape not in shapes and on != surface}


def for_other_tools(prior: PushPosterior) -> PushPosterior:
    """The same with a friction as wide as that of tools of other materials than the sets' steel."""
    greatest, deviations = _OTHER_TOOLS
    friction = (math.log(greatest) - prior.mean[0]) / deviations
    return PushPosterior.prior(
        len(prior.parameters),
        mean=prior.mean,
        deviation=(friction, *prior.deviation[1:]),
        residual=prior.residual,
        registration=prior.registration,
    )


def chosen_factor(held: Mapping[str, Mapping[str, Mapping[str, float]]], shapes: Collection[str]) -> float:
    """The least factor with which regions of 90 % hold 90 % of the pushes of other shapes, and 82 % of each shape's.

    Args:
        held: shares, by set, by the shape that was left out with its own, by factor.
        shapes: that are not looked at.
    """
    each = [
        _over_others({name: line for name, line in held.items() if name.split()[1] == shape}, shapes)
        for shape in dict.fromkeys(name.split()[1] for name in held)
        if shape not in shapes
    ]
    shares = np.array([[means[f"{factor:g}"] for means in each] for factor in FACTORS])
    return max(_reached(shares.mean(1), _HELD[0]), _reached(shares.min(1), _HELD[1]))


def _reached(shares: np.ndarray, wanted: float) -> float:
    """The least factor with which a share is reached, linear between those that were tried."""
    enough = np.flatnonzero(shares >= wanted - 1e-9)
    if not len(enough) or enough[0] == 0:
        return FACTORS[0] if len(enough) else FACTORS[-1]
    at = slice(enough[0] - 1, enough[0] + 1)
    return float(np.interp(wanted, shares[at], FACTORS[at]))


def _over_others(found: Mapping[str, Mapping[str, Mapping[str, float]]], shapes: Collection[str]) -> dict[str, float]:
    lines = [
        line[left]
        for name, line in found.items()
        if name.split()[1] not in shapes
        for left in (shapes or line)  # without any left out: over all pairs
    ]
    return {name: float(np.mean([line[name] for line in lines])) for name in lines[0]}


@cache
def shift_scales(names: tuple[str, ...]) -> Parameters:
    """Scales of the shifts of tool and outline in some sets (Student-t of greatest likelihood about 0)."""
    shifts = torch.tensor([_shifts(name) for name in names], dtype=torch.float64)
    tool, outline, yaw = (_t_scale(part.flatten()) for part in shifts.split((2, 2, 1), -1))
    return (tool, tool, outline, outline, yaw)


def _t_scale(values: Tensor) -> float:
    square, scale = values.square(), values.square().mean()
    for _ in range(50):  # expectation-maximisation
        scale = ((_SHIFT_TAILS + 1.0) / (_SHIFT_TAILS + square / scale) * square).mean()
    return float(scale.sqrt())


@cache
def _shifts(name: str) -> Parameters:
    own = push_set(name)
    return Registration().learnt(own.observed(torch.arange(len(own.start))), own.body).mean


@cache
def residual_of(fits: tuple[tuple[str, tuple[float, ...]], ...]) -> PushResidual:
    """The residual of greatest likelihood, of sets predicted by their own fits."""
    pairs = [_residuals(name, parameters) for name, parameters in fits]
    off, way = torch.cat([pair[0] for pair in pairs]), torch.cat([pair[1] for pair in pairs])
    usual = PushResidual()
    logs = torch.tensor([*usual.floor_m, *usual.share, usual.tails], dtype=torch.float64).log().requires_grad_()
    search = torch.optim.LBFGS([logs], max_iter=100, line_search_fn="strong_wolfe")

    def cost() -> float:
        search.zero_grad()
        scale = torch.hypot(logs[:3].exp().expand(len(way), 3), way[:, None] * logs[3:6].exp())
        tails, square = logs[6].exp(), (off / scale).square().sum(-1)
        constant = torch.lgamma(0.5 * (tails + 3.0)) - torch.lgamma(0.5 * tails) - 1.5 * tails.log()
        density = constant - scale.log().sum(-1) - 0.5 * (tails + 3.0) * torch.log1p(square / tails)
        loss = -density.mean()
        loss.backward()
        return float(loss.detach())

    search.step(cost)
    numbers = logs.detach().exp().tolist()
    return PushResidual(tuple(numbers[:3]), tuple(numbers[3:6]), numbers[6])


@cache
def scale_spread(fits: tuple[tuple[str, tuple[float, ...]], ...]) -> float:
    """Deviation of the log of an object's own scale: scatter of the sets', as of the parameters."""
    common = residual_of(fits)
    logs = torch.tensor([_log_scale(name, parameters, common) for name, parameters in fits], dtype=torch.float64)
    shapes = len({name.split()[1] for name, _ in fits})
    return math.sqrt((shapes + 1.0) / (shapes - 1.0)) * float(logs.std(correction=0))


def _log_scale(name: str, parameters: tuple[float, ...], common: PushResidual) -> float:
    """Log of the multiple of a common scale that a set's own residuals have (expectation-maximisation)."""
    off, way = _residuals(name, parameters)
    square = (off / common.scale(way)).square().sum(-1)
    scale = torch.ones((), dtype=torch.float64)
    for _ in range(100):
        scale = ((common.tails + 3.0) / (common.tails + square / scale) * square).mean() / 3.0
    return 0.5 * math.log(float(scale))


@cache
def _residuals(name: str, parameters: tuple[float, ...]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
    """Of a set by its fit: along the tip's way, across it, turn times the base's radius; and the predicted ways."""
    own = push_set(name)
    rows = torch.arange(len(own.start))
    one = PushPosterior(
        torch.tensor([parameters], dtype=torch.float64),
        torch.zeros(1, dtype=torch.float64),
        registration=Registration().learnt(own.observed(rows), own.body),
    )
    shown = predicted(one, own, rows)
    residual = shown.residual_of(own.end[:, None])[:, 0, 0]
    floor, share = one.residual.floor_m[0], one.residual.share[0]
    return residual, (shown.scale[:, 0, 0].square() - floor**2).clamp_min(0.0).sqrt() / share
