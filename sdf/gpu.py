"""GPU kernels: one source for GPU and CPU, compiled by warp at their first use and launched on torch's tensors.

An operation's warp version stands in `x_warp.py` beside `x_numba.py`, and runs by itself on CUDA tensors; on a CPU,
where numba's is quicker, only where it is forced, as tests do. Compiled kernels are kept beside the others' folder.
"""

import importlib.util
import os
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sdf import check
from sdf.extras import optional

VERSION = "warp"
LANES = 32
"""Threads of a GPU that share one piece of work, where a kernel is launched with lanes: they run in step there."""
_REALS = (torch.float32, torch.float64)


@cache
def available() -> bool:
    """Whether warp is installed; without it plain versions run on CUDA tensors."""
    return importlib.util.find_spec("warp") is not None


def supports(*tensors: Tensor) -> bool:
    """Whether a warp version can run on these tensors: CPU or CUDA, float32 or float64, no graph to be kept."""
    if not check.is_eager():
        return False
    graph = torch.is_grad_enabled()
    for tensor in tensors:
        if tensor.device.type not in ("cpu", "cuda") or (graph and tensor.requires_grad):
            return False
        if tensor.is_floating_point() and tensor.dtype not in _REALS:
            return False
    return True


def suits(*tensors: Tensor) -> bool:
    """Whether a warp version is the one to run without being forced: on CUDA tensors, where warp is installed."""
    return any(tensor.device.type == "cuda" for tensor in tensors) and available()


def no_waits(device: torch.device) -> AbstractContextManager[None]:
    """Within the block nobody looks into tensors of this device, if it is a GPU that warp's versions run on."""
    return check.no_waits() if device.type == "cuda" and available() else nullcontext()


def fetched(*tensors: Tensor) -> list[Tensor]:
    """Tensors on the host: those of a GPU in one copy, for which it waits once, in the first one's dtype."""
    if tensors[0].device.type != "cuda":
        return list(tensors)
    flat = torch.cat([tensor.reshape(-1).to(tensors[0].dtype) for tensor in tensors]).cpu()
    parts = flat.split([tensor.numel() for tensor in tensors])
    return [part.view(tensor.shape) for part, tensor in zip(parts, tensors, strict=True)]


def after_all(device: torch.device, now: Callable[[], float]) -> Callable[[], float]:
    """A clock that is read when a GPU has done all that it was asked for."""
    if device.type != "cuda":
        return now

    def when_done() -> float:
        torch.cuda.synchronize(device)
        return now()

    return when_done


@dataclass(frozen=True)
class Numbers:
    """Annotation of a kernel's argument that is a few reals, handed over by value.

    Attributes:
        count: of the reals.
    """

    count: int


class Kernel:
    """A function over arrays that warp compiles for each float type; `launch` runs it, once a thread.

    Reals are annotated as `Any`, `warp.array(dtype=Any)`, or `Any` itself for a scalar, a few of them as `Numbers(n)`.
    Tensors go in without a copy, with the strides that they have; other arguments go in by value.

    Args:
        function: what warp compiles. It has no result; a thread knows its place from `warp.tid()`.
    """

    def __init__(self, function: Callable[..., None]) -> None:
        own, self.name = warp(), function.__name__.strip("_")
        kinds = {name: kind for name, kind in function.__annotations__.items() if name != "return"}
        function.__annotations__ = {n: Any if isinstance(kind, Numbers) else kind for n, kind in kinds.items()}
        generic = own.kernel(function, enable_backward=False)
        self.module = generic.module
        self._kinds, self._overloads = {}, {}
        for dtype, real in zip(_REALS, (own.float32, own.float64), strict=True):
            self._kinds[dtype] = [_concrete(kind, real) for kind in kinds.values()]
            self._overloads[dtype] = own.overload(generic, self._kinds[dtype]) if generic.is_generic else generic

    def launch(
        self,
        shape: int | Sequence[int],
        *arguments: Any,  # noqa: ANN401  (whatever the function takes)
        lanes: bool = False,
    ) -> None:
        """Run it on the device of the tensors, in torch's current stream there; the host does not wait.

        Args:
            shape: of the threads, one axis for each index of `warp.tid()`, without that of the lanes.
            arguments: of the function; sequences for `Numbers`.
            lanes: whether several threads share each piece of work (`lanes_warp`): `LANES` on a GPU, one on a CPU.

        Raises:
            ValueError: the tensors are on several devices, or there are none.
        """
        tensors = [argument for argument in arguments if isinstance(argument, Tensor)]
        if len(devices := {tensor.device for tensor in tensors}) != 1:
            raise ValueError(f"Expected the tensors of {self.name} on one device, got {sorted(map(str, devices))}")
        dtype = next((tensor.dtype for tensor in tensors if tensor.is_floating_point()), _REALS[0])
        given = [_given(argument, kind) for argument, kind in zip(arguments, self._kinds[dtype], strict=True)]
        enqueue(self._overloads[dtype], shape, given, tensors[0].device, lanes=lanes)


def _concrete(kind: Any, real: Any) -> Any:  # noqa: ANN401
    """The type of an argument for one type of reals."""
    own = warp()
    if isinstance(kind, Numbers):
        return own.types.vector(kind.count, real)
    if isinstance(kind, own.array):
        return own.array(dtype=real if kind.dtype is Any else kind.dtype, ndim=kind.ndim)
    return real if kind is Any else kind


def _given(argument: Any, kind: Any) -> Any:  # noqa: ANN401
    """An argument as warp takes it."""
    if isinstance(argument, Tensor):
        return array(argument)
    return kind(*argument) if isinstance(argument, tuple | list) else argument


def array(tensor: Tensor) -> Any:  # noqa: ANN401  (warp comes without types)
    """Warp's description of a tensor's memory, without a copy."""
    return warp().from_torch(tensor.detach(), requires_grad=False, return_ctype=True)


@cache
def constant(numbers: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """A few numbers as a tensor that is made once a device, so that no later pass waits for it; not to be changed."""
    return torch.tensor(numbers, dtype=dtype, device=device)


def enqueue(
    kernel: Any,  # noqa: ANN401
    shape: int | Sequence[int],
    arguments: list[Any],
    device: torch.device,
    *,
    lanes: bool = False,
) -> None:
    """Launch a kernel of warp's: the one place that does."""
    own = warp()
    stream = own.stream_from_torch(device) if device.type == "cuda" else None
    block: dict[str, int] = {}
    if lanes:
        # a CPU has one lane, unless it is told to pretend blocks
        block["block_dim"] = LANES if device.type == "cuda" or own.config.enable_cpu_blocks else 1
        shape = (*([shape] if isinstance(shape, int) else shape), block["block_dim"])
    own.launch(kernel, shape, arguments, device=own.device_from_torch(device), stream=stream, **block)


@cache
def warp() -> Any:  # noqa: ANN401  (it comes without types)
    """Warp, made to keep its kernels beside the others.

    Raises:
        ModuleNotFoundError: it is not installed; the message says what installs it.
    """
    own = optional("warp", "Running on a GPU")
    if own.config.kernel_cache_dir is None and "WARP_CACHE_PATH" not in os.environ:
        own.config.kernel_cache_dir = str(folder())
    own.config.log_level = max(own.config.log_level, own.LOG_WARNING)
    own.init()
    return own


def folder() -> Path:
    """Folder of what warp compiles: `rumi/kernels` of the user's cache; warp tells versions and devices apart."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rumi" / "kernels" / "warp"
