"""References to fifty digits, by mpmath: plain formulas without any care for small numbers, which precision pays."""

import importlib
import importlib.util
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from sdf.extras import optional

DIGITS = 50


def available() -> bool:
    """Whether mpmath is installed."""
    return importlib.util.find_spec("mpmath") is not None


def mp() -> Any:  # noqa: ANN401  (comes without types)
    """The module mpmath, set to `DIGITS`.

    Raises:
        ModuleNotFoundError: it is not installed; the message says what brings it.
    """
    module: Any = optional("mpmath", "This sweep")
    module.mp.dps = DIGITS
    return module


def rotation(omega: Any) -> Any:  # noqa: ANN401  (numbers of mpmath)
    """Rodrigues' formula of three numbers: a 3 x 3 matrix."""
    m = mp()
    theta = m.sqrt(sum(x * x for x in omega))
    x, y, z = omega
    cross = m.matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if theta == 0:
        return m.eye(3) + cross
    return m.eye(3) + cross * (m.sin(theta) / theta) + cross * cross * ((1 - m.cos(theta)) / theta**2)


def transform(twist: Any) -> Any:  # noqa: ANN401  (numbers of mpmath)
    """Exponential of a twist (v, omega): a 4 x 4 matrix."""
    m = mp()
    v, omega = m.matrix(twist[:3]), twist[3:]
    theta = m.sqrt(sum(x * x for x in omega))
    x, y, z = omega
    cross = m.matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    jacobian = m.eye(3) + cross / 2
    if theta != 0:
        jacobian = m.eye(3) + cross * ((1 - m.cos(theta)) / theta**2)
        jacobian = jacobian + cross * cross * ((theta - m.sin(theta)) / theta**3)
    turned, moved = rotation(omega), jacobian * v
    result = m.eye(4)
    for i in range(3):
        for j in range(3):
            result[i, j] = turned[i, j]
        result[i, 3] = moved[i]
    return result


def by_row(function: Callable[[list[Any]], Any], rows: Float[Tensor, "n d"]) -> Float[Tensor, "n ..."]:
    """A function of mpmath numbers over the rows of a tensor, rounded to float64."""
    m = mp()
    results = []
    for row in rows.detach().double().tolist():
        value = function([m.mpf(x) for x in row])
        results.append(value.tolist() if hasattr(value, "tolist") else value)
    return torch.tensor(_floats(results), dtype=torch.float64)


def derivative(function: Callable[[list[Any]], Any], row: list[Any], along: int) -> Any:  # noqa: ANN401
    """Central difference with a step of 1e-20, of which half of the digits are right."""
    m = mp()
    step = m.mpf(10) ** -20
    ahead, behind = list(row), list(row)
    ahead[along] += step
    behind[along] -= step
    return (function(ahead) - function(behind)) / (2 * step)


def _floats(value: Any) -> Any:  # noqa: ANN401  (nested lists)
    return [_floats(item) for item in value] if isinstance(value, list) else float(value)
