"""Settings, warm start and results of sampling model predictive control."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Self, get_args

import torch
from jaxtyping import Float
from torch import Tensor

KernelName = Literal["rbf", "matern32", "matern52", "bspline3"]
CostScale = Literal["raw", "std"]

Objective = Callable[[Float[Tensor, "*b K H A"]], Float[Tensor, "*b K"]]
"""Costs (*b, K) of K control sequences (*b, K, H, A) of each scene; lower is better.

One that is not finite is never followed.
"""


class NonFiniteCostsError(ValueError):
    """No sample has a finite cost, so there is nothing to follow."""


@dataclass(frozen=True)
class ControlPlan:
    """A nominal control sequence, one or one a scene: what the next planning starts from.

    Attributes:
        knots: (*b, S, A), control points, within the limits.
        controls: (*b, H, A), the controls they stand for, clipped to the limits: what to execute.
    """

    knots: Float[Tensor, "*b S A"]
    controls: Float[Tensor, "*b H A"]

    def to(self, *args: torch.device | torch.dtype | str) -> Self:
        """Move to a device or a floating dtype."""
        return type(self)(self.knots.to(*args), self.controls.to(*args))  # type: ignore[call-overload]


@dataclass(frozen=True)
class Rollouts:
    """The samples of the last iteration.

    Attributes:
        controls: (*b, K, H, A), as they were evaluated: clipped to the limits.
        costs: (*b, K), as the objective gave them.
        weights: (*b, K), summing to 1; 0 where the cost is not finite.
        ess: (*b), effective sample size, 1 / sum of squared weights, between 1 and K. Near 1 the update is an arg-min.
        iterations: how many iterations were done.
    """

    controls: Float[Tensor, "*b K H A"]
    costs: Float[Tensor, "*b K"]
    weights: Float[Tensor, "*b K"]
    ess: Float[Tensor, "*b"]
    iterations: int

    @property
    def best(self) -> Float[Tensor, "*b H A"]:
        """The controls of least finite cost."""
        least = torch.where(self.costs.isfinite(), self.costs, torch.inf).argmin(-1)
        return self.controls.take_along_dim(least[..., None, None, None], -3).squeeze(-3)


@dataclass(frozen=True)
class MPPISettings:
    """Settings of MPPI, with `knots` KMPPI, with `changes` SMPPI; the defaults are RUMI's (IV-I and V.F, Table IV).

    Attributes:
        horizon: control steps H.
        knots: control points S of KMPPI, evenly spread from the first step to the last; None samples every step
            by itself (MPPI).
        changes: sample the changes from each control to the next (SMPPI); `knots` is None then, and `noise_variance`
            the changes'.
        change_cost: weight of the squared changes between following controls, in units of the cost, that is added to
            each sample's cost (SMPPI's action cost); 0 leaves it out.
        kernel: time kernel that interpolates between the knots.
        kernel_scale: its length, steps.
        samples: control sequences K an iteration.
        noise_variance: variance of the sampled noise of every knot, one for all control dimensions or one each,
            control units squared.
        temperature: lambda of the weights `softmax(-cost / temperature)`, in units of the (scaled) cost.
        control_min: lower limit, one for all control dimensions or one each.
        control_max: upper limit, likewise.
        cost_scale: "raw" weighs the costs as they are; "std" divides them by their standard deviation over the
            samples first, so that the temperature does not depend on the cost's unit. With raw costs that spread
            by far more than the temperature the weights are those of an arg-min (`Rollouts.ess` tells).
        warmup_iterations: iterations for a fresh plan, before anything is executed.
        iterations: iterations for every later plan.
        include_nominal: make the first sample the nominal sequence itself.
        perturbation_cost: weigh by the ratio of the nominal and the sampled distribution too
            (`temperature * nominal^T variance^-1 noise`).
    """

    horizon: int = 15
    knots: int | None = 8
    changes: bool = False
    change_cost: float = 0.0
    kernel: KernelName = "rbf"
    kernel_scale: float = 2.0
    samples: int = 500
    noise_variance: float | tuple[float, ...] = 1.5
    temperature: float = 0.01
    control_min: float | tuple[float, ...] = -1.0
    control_max: float | tuple[float, ...] = 1.0
    cost_scale: CostScale = "raw"
    warmup_iterations: int = 10
    iterations: int = 1
    include_nominal: bool = True
    perturbation_cost: bool = True

    def __post_init__(self) -> None:
        for name, least in (("horizon", 1), ("samples", 1), ("warmup_iterations", 0), ("iterations", 1)):
            _check_count(name, getattr(self, name), least)
        if self.include_nominal and self.samples < 2:
            raise ValueError(f"Expected samples to be at least 2 with include_nominal, got {self.samples}")
        self._check_knots()
        for name, valid in (("kernel", get_args(KernelName)), ("cost_scale", get_args(CostScale))):
            if getattr(self, name) not in valid:
                raise ValueError(f"Expected {name} to be one of {', '.join(valid)}, got {getattr(self, name)!r}")
        if not (math.isfinite(self.change_cost) and self.change_cost >= 0):
            raise ValueError(f"Expected change_cost to be 0 or more and finite, got {self.change_cost}")
        for name in ("kernel_scale", "temperature", "noise_variance"):
            if not all(math.isfinite(value) and value > 0 for value in _values(getattr(self, name))):
                raise ValueError(f"Expected {name} to be positive and finite, got {getattr(self, name)}")
        self._check_limits()

    def _check_knots(self) -> None:
        if self.knots is None:
            return
        if self.changes:
            raise ValueError(f"Expected knots to be None where changes are sampled, got {self.knots}")
        _check_count("knots", self.knots, 1)
        if self.knots > self.horizon or (self.knots == 1 and self.horizon > 1):
            raise ValueError(
                f"Expected knots to be between {min(2, self.horizon)} and the horizon of {self.horizon}, since they "
                f"spread from the first step to the last, got {self.knots}: change it, or set it to None for MPPI"
            )

    def _check_limits(self) -> None:
        low, high = _values(self.control_min), _values(self.control_max)
        if len(low) != len(high) and 1 not in (len(low), len(high)):
            raise ValueError(f"Expected as many control_min as control_max, got {len(low)} and {len(high)}")
        count = max(len(low), len(high))
        pairs = zip(low * (count // len(low)), high * (count // len(high)), strict=True)
        if not all(math.isfinite(a) and math.isfinite(b) and a < b for a, b in pairs):
            raise ValueError(
                "Expected control_min to be finite and below a finite control_max, "
                f"got {self.control_min} and {self.control_max}"
            )


def _check_count(name: str, value: int, least: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ValueError(f"Expected {name} to be a whole number of at least {least}, got {value!r}")


def _values(value: float | tuple[float, ...]) -> tuple[float, ...]:
    return tuple(value) if isinstance(value, tuple) else (value,)
