"""What is sampled, and how it becomes controls: the one difference between MPPI and KMPPI is a matrix."""

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
    """MPPI's or KMPPI's, by whether the settings name a number of knots."""
    if settings.knots is None:
        return PerStep(settings.horizon)
    return KernelKnots(settings.horizon, settings.knots, settings.kernel, settings.kernel_scale)


def _check_steps(steps: int) -> None:
    if steps < 0:
        raise ValueError(f"Expected steps to be 0 or more, got {steps}")
