"""Kernels that numba compiles for the CPU at their first use: what they need, and what is said meanwhile."""

import importlib.util
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

_FLOATS = (torch.float32, torch.float64)


@cache
def available() -> bool:
    """Whether numba is installed; without it the plain versions run."""
    return importlib.util.find_spec("numba") is not None


def supports(*tensors: Tensor) -> bool:
    """Whether a fused CPU version can run on these tensors: on the CPU, float32 or float64, no graph to be kept."""
    graph = torch.is_grad_enabled() and any(t.requires_grad for t in tensors)
    floats = [t.dtype for t in tensors if t.is_floating_point()]
    return (
        available()
        and not graph
        and all(t.device.type == "cpu" for t in tensors)
        and all(dtype in _FLOATS for dtype in floats)
        and not torch.compiler.is_compiling()
    )


class Kernel:
    """A function over NumPy arrays that numba compiles, in parallel, for torch's number of threads.

    Compiled code is kept beside the source, or where that is read-only in the user's cache.

    Args:
        function: what numba compiles; its loops over `numba.prange` run in parallel.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        import numba

        self._numba: Any = numba
        self._most = int(self._numba.config.NUMBA_NUM_THREADS)
        self._compiled = numba.njit(cache=True, parallel=True, error_model="numpy")(function)
        self._announced = False

    def __call__(self, *arguments: Any) -> Any:  # noqa: ANN401  (whatever the function takes and gives)
        """Run it."""
        self._announce()
        self._numba.set_num_threads(max(1, min(torch.get_num_threads(), self._most)))
        return self._compiled(*arguments)

    def _announce(self) -> None:
        """Say once that compiling takes a while, where nothing compiled is kept yet."""
        if self._announced:
            return
        self._announced = True
        function = self._compiled.py_func
        kept = Path(str(self._compiled.stats.cache_path)).glob(f"*.{function.__name__}-*.nbi")
        if next(kept, None) is None:
            sys.stderr.write(f"rumi: compiling {function.__name__} for this processor (seconds, once)\n")
            sys.stderr.flush()
