"""Steps of one tool along the arm's limit, as plain numbers have them: a guess that `Tool` checks."""

import functools
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sdf.compiled import interpreted


@functools.cache
def _plain(name: str) -> Any:  # noqa: ANN401  (a function of numbers)
    """A function of `tool_numba` that takes plain numbers, uncompiled."""
    from rumi.robot import tool_numba

    return interpreted(getattr(tool_numba, name))


def guessed_steps(arrays: tuple[Any, ...], q: Float[Tensor, "Q"], steps: Float[Tensor, "n Q"]) -> Float[Tensor, "n Q"]:
    """Where each of some steps ends: the way that it takes in float64, and along that the definition's own operations.

    Args:
        arrays: what limits a step, as `Tool.arm_arrays` gives it, with an arm.
        q: configuration now.
        steps: what is added to it in each, metres and radians.
    """
    # views whose entries are Python's own numbers: those of arrays take twice as long
    table, bounds = (np.ascontiguousarray(part, np.float64).data for part in (arrays[0], arrays[2]))
    base, limits = (np.asarray(part, np.float64).tolist() for part in (arrays[1], arrays[3]))
    low, high, near = (np.asarray(part, q.numpy().dtype) for part in (*arrays[2], arrays[1][:2]))
    step_within, parts = _plain("step_within"), int(limits[3])
    now, found = q.numpy(), np.empty(steps.shape, low.dtype)
    left = _plain("residual")(*_numbers(now), table, base, limits)
    for index, step in enumerate(steps.numpy()):
        wanted = now + step
        wanted[:-1] = np.maximum(np.minimum(wanted[:-1], high), low)
        *_, left, passed, way = step_within(*_numbers(now), *_numbers(wanted), left, table, base, bounds, limits)
        now = found[index] = _carried_out(now, wanted, passed / parts, way, near, low, high)
    return torch.from_numpy(found)


def _numbers(q: np.ndarray) -> tuple[float, float, float, float]:
    """x, y, z (0 in a plane), yaw."""
    values = q.tolist()
    return values[0], values[1], values[2] if len(values) == 4 else 0.0, values[-1]


def _carried_out(
    q: np.ndarray, wanted: np.ndarray, share: float, way: int, base: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """End of a step by one of the ways of `tool_numba`, each operation rounded as in `Tool`."""
    from rumi.robot.tool_numba import CARRIED, STAYED, WHOLE, WITHOUT_TURN

    if way == WHOLE:
        return wanted
    halfway = q + q.dtype.type(share) * (wanted - q)
    if way == STAYED:
        return halfway
    end = wanted.copy()
    if way == WITHOUT_TURN:
        end[-1] = halfway[-1]
        return end
    offset, target = halfway[:2] - base, wanted[:2] - base
    # lengths and angles by the library whose last digit counts
    radius, length = torch.linalg.vector_norm(torch.from_numpy(np.stack((offset, target))), dim=-1).numpy()
    end[:2] = np.maximum(np.minimum(base + target * (radius / max(length, q.dtype.type(1e-9))), high[:2]), low[:2])
    if way == CARRIED:
        aside = offset[0] * target[1] - offset[1] * target[0]
        ahead = offset[0] * target[0] + offset[1] * target[1]
        pair = torch.from_numpy(np.array([[aside, ahead]]))
        end[-1] = halfway[-1] + torch.atan2(*pair.unbind(-1)).numpy()[0]
    return end
