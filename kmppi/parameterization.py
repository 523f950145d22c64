"""Parameterizations of control sequences: a matrix from samples to controls for MPPI, SMPPI and KMPPI."""

import torch
from jaxtyping import Float
from torch import Tensor

from kmppi.kernels import kernel_matrix
from kmppi.types import KernelName, MPPISettings

MAX_CONDITION = 1e6


class Parameterization:
    """Control points (S, A) that stand for controls (H, A), both linear maps, kept in float64.

    Attributes:
        matrix: (H, S), controls from knots.
    """

    matrix: Float[Tensor, "H S"]

    @property
    def horizon(self) -> int:
        """Control steps H."""
        return self.matrix.shape[0]

    @property
    def knots(self) -> int:
        """Control points S."""
        return self.matrix.shape[1]

    def shift_matrix(self, steps: int) -> Float[Tensor, "S S"]:
        """(S, S), the knots that stand for the same controls `steps` steps later."""
        raise NotImplementedError  # abstract: every member has one

    def bound(
        self, knots: Float[Tensor, "*k S A"], low: Float[Tensor, "A"], high: Float[Tensor, "A"]
    ) -> Float[Tensor, "*k S A"]:
        """The nearest knots within limits of the controls; here the knots themselves are clipped."""
        return torch.clamp(knots, low, high)


class PerStep(Parameterization):
    """MPPI: every step is sampled by itself.

    Args:
        horizon: control steps H.
    """

    def __init__(self, horizon: int) -> None:
        self.matrix = torch.eye(horizon, dtype=torch.float64)

    def shift_matrix(self, steps: int) -> Float[Tensor, "S S"]:
        """(H, H), drops the first `steps` controls and appends zeros (RUMI, IV-G)."""
        _check_steps(steps)
        if steps >= self.horizon:
            return torch.zeros_like(self.matrix)
        return torch.diag(torch.ones(self.horizon - steps, dtype=torch.float64), steps)


class Changes(Parameterization):
    """SMPPI: the change from each control to the next is sampled; the first one is the first control itself.

    Smooth MPPI (Kim et al., arXiv 2112.09988) lifts the controls to their derivative. Here that is the derivative in
    time, `u_t = u_(t-1) + v_t`, so that noise is a random walk over the horizon; the authors of RUMI, in public code,
    sum v over iterations instead and leave each step's noise independent.

    Args:
        horizon: control steps H.
    """

    def __init__(self, horizon: int) -> None:
        self.matrix = torch.ones(horizon, horizon, dtype=torch.float64).tril()

    def shift_matrix(self, steps: int) -> Float[Tensor, "S S"]:
        """(H, H), the controls from `steps` on, the last one held."""
        _check_steps(steps)
        moved = torch.zeros_like(self.matrix)
        if steps < self.horizon:
            moved += torch.diag(torch.ones(self.horizon - steps, dtype=torch.float64), steps)
        moved[0, : steps + 1] = 1.0
        return moved

    def bound(
        self, knots: Float[Tensor, "*k S A"], low: Float[Tensor, "A"], high: Float[Tensor, "A"]
    ) -> Float[Tensor, "*k S A"]:
        """The changes between the clipped controls: past a limit nothing is stored up."""
        controls = torch.clamp(knots.cumsum(-2), low, high)
        return torch.diff(controls, dim=-2, prepend=torch.zeros_like(controls[..., :1, :]))


class KernelKnots(Parameterization):
    """KMPPI: a few knots, evenly spread over the horizon, and a kernel on time between them (RUMI, Eq 32).

    `W = K(Hu, Hv) K(Hv, Hv)^-1`, with Hu = 0..H-1 and Hv from 0 to H-1. The paper prints the kernel on the controls;
    the one it means is on times. W is not a partition of unity: rows sum to 1 within some percent and their absolute
    values to more, up to 1.85 for H = 15, S = 8, scale 2, so that knots within limits can stand for controls beyond.

    Args:
        horizon: control steps H.
        knots: control points S, 2..H (1 only where H is 1).
        kernel: name of the time kernel.
        scale: its length, steps.

    Raises:
        ValueError: the kernel matrix of the knots is too close to singular to interpolate with.
    """

    def __init__(self, horizon: int, knots: int, kernel: KernelName = "rbf", scale: float = 2.0) -> None:
        self.kernel: KernelName = kernel
        self.scale = scale
        self.times = torch.linspace(0.0, horizon - 1.0, knots, dtype=torch.float64)
        self._gram = kernel_matrix(kernel, self.times, self.times, scale)
        condition = float(torch.linalg.cond(self._gram))
        # not `>`: a singular matrix may give nan
        if not condition <= MAX_CONDITION:
            raise ValueError(
                f"Expected the {kernel} kernel of {knots} knots over a horizon of {horizon} to be well conditioned "
                f"(below {MAX_CONDITION:.0e}), got {condition:.1e} at kernel_scale {scale}: use fewer knots or a "
                "smaller kernel_scale"
            )
        self.matrix = self._interpolation(torch.arange(horizon, dtype=torch.float64))

    def shift_matrix(self, steps: int) -> Float[Tensor, "S S"]:
        """(S, S), `K(Hv + steps, Hv) K(Hv, Hv)^-1`: the same curve, sampled later.

        Not the power `shift_matrix(1) ** steps`, which samples and interpolates anew each time. Knots beyond the
        horizon are extrapolated and decay towards 0.
        """
        _check_steps(steps)
        return self._interpolation(self.times + steps)

    def _interpolation(self, times: Float[Tensor, "R"]) -> Float[Tensor, "R S"]:
        cross = kernel_matrix(self.kernel, times, self.times, self.scale)
        matrix: Tensor = torch.linalg.solve(self._gram, cross, left=False)
        return matrix


def make_parameterization(settings: MPPISettings) -> Parameterization:
    """KMPPI's if the settings name a number of knots, SMPPI's if they ask for changes, else MPPI's."""
    if settings.changes:
        return Changes(settings.horizon)
    if settings.knots is None:
        return PerStep(settings.horizon)
    return KernelKnots(settings.horizon, settings.knots, settings.kernel, settings.kernel_scale)


def _check_steps(steps: int) -> None:
    if steps < 0:
        raise ValueError(f"Expected steps to be 0 or more, got {steps}")
