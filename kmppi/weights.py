"""Importance weights of samples from their costs."""

import torch
from jaxtyping import Float
from torch import Tensor

from kmppi.types import CostScale, NonFiniteCostsError


def perturbation_cost(
    nominal: Float[Tensor, "*b S A"],
    noise: Float[Tensor, "*k S A"],
    noise_variance: Float[Tensor, "A"],
    temperature: float,
) -> Float[Tensor, "*k"]:
    """`temperature * nominal^T variance^-1 noise`: what weighing must know of drawing around the nominal (RUMI, [50]).

    Taken over the knots, where the samples are drawn: there it is the exact ratio of likelihoods. With the controls
    of KMPPI and the knots' variance it would be off (about 1.8 times), since the controls of neighbouring steps
    are correlated.

    Args:
        nominal: (*b, S, A), knots that were sampled around.
        noise: (*k, S, A), what was added to them; (*b, K, S, A) where there are several nominal ones.
        noise_variance: (A,), of each control dimension.
        temperature: lambda, in units of cost.

    Returns:
        (*k), units of cost.
    """
    scaled = (nominal / noise_variance).flatten(-2)
    if scaled.ndim == 1:
        return temperature * (noise.flatten(-2) @ scaled)
    return temperature * (noise.flatten(-2) @ scaled[..., None])[..., 0]


def scale_costs(costs: Float[Tensor, "F"], cost_scale: CostScale) -> Float[Tensor, "F"]:
    """Finite costs (F,) from 0 up, as they are ("raw") or in standard deviations ("std"; equal costs stay 0)."""
    if cost_scale == "raw":
        return costs - costs.min()
    # of order 1 first, so that squares neither overflow nor vanish
    largest = costs.abs().max()
    unit = costs / torch.where(largest > 0, largest, 1.0)
    deviation = unit.std(correction=0)
    return (unit - unit.min()) / torch.where(deviation > 0, deviation, 1.0)


def sample_weights(
    costs: Float[Tensor, "*b K"],
    temperature: float,
    *,
    cost_scale: CostScale = "raw",
    perturbation: Float[Tensor, "*b K"] | None = None,
) -> Float[Tensor, "*b K"]:
    """`softmax(-(cost + perturbation) / temperature)` in float64, and 0 for every cost that is not finite.

    Args:
        costs: (*b, K), of any scale; each scene of a batch by itself.
        temperature: in units of the scaled cost.
        cost_scale: how the costs are scaled first, by the finite ones alone.
        perturbation: (*b, K), added after the scaling.

    Returns:
        (*b, K), float64, summing to 1; the same when a constant is added to all costs.

    Raises:
        NonFiniteCostsError: no cost of a scene is finite; its weights are NaN then where it is traced, and on a GPU.
    """
    finite = costs.abs() < torch.inf
    traced = torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active()
    if traced or costs.device.type == "cuda":
        return _masked_weights(costs.double(), finite, temperature, cost_scale, perturbation)
    if not bool(finite.any(-1).all()):
        raise NonFiniteCostsError(
            f"Expected at least one finite cost, got {costs.shape[-1]} of nan or infinity: check the objective, "
            "whose samples start with the nominal controls"
        )
    if costs.ndim > 1:
        return _masked_weights(costs.double(), finite, temperature, cost_scale, perturbation)
    count = int(finite.sum())
    # float64: costs far above the temperature must still be told apart where they differ little
    wide = costs.double()
    scaled = scale_costs(wide if count == costs.numel() else wide[finite], cost_scale)
    if perturbation is not None:
        scaled = scaled + (perturbation if count == costs.numel() else perturbation[finite])
    weights = torch.softmax(-scaled / temperature, 0)
    return weights if count == costs.numel() else torch.zeros_like(wide).masked_scatter_(finite, weights)


def _masked_weights(
    wide: Tensor, finite: Tensor, temperature: float, cost_scale: CostScale, perturbation: Tensor | None
) -> Tensor:
    """The same of each scene without a look at how many costs are finite, as tracing and a GPU need it."""
    scaled = wide.where(finite, torch.inf)
    scaled = (scaled - scaled.amin(-1, keepdim=True)).where(finite, 0.0)
    if cost_scale == "std":
        largest = scaled.amax(-1, keepdim=True)
        unit = scaled / torch.where(largest > 0, largest, 1.0)
        count = finite.sum(-1, keepdim=True, dtype=wide.dtype)
        centred = (unit - unit.sum(-1, keepdim=True) / count) * finite
        deviation = centred.norm(dim=-1, keepdim=True) / count.sqrt()
        scaled = unit / torch.where(deviation > 0, deviation, 1.0)
    if perturbation is not None:
        scaled = scaled + perturbation
    return torch.softmax((-scaled / temperature).where(finite, -torch.inf), -1)
