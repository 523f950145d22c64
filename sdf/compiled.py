"""Numba kernels for the CPU, compiled at their first use and kept in the user's cache."""

import gc
import hashlib
import importlib.util
import sys
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sdf.check import is_eager
from sdf.threads import count, divide

_FLOATS = (torch.float32, torch.float64)
_FAST = {"reassoc", "contract", "arcp", "nsz"}


@cache
def available() -> bool:
    """Whether numba is installed, which is loaded then; without it the plain versions run."""
    if importlib.util.find_spec("numba") is None:
        return False
    _load()
    return True


def _load() -> None:
    """Load numba without scipy's linear algebra, 15 MB that it loads to see whether they are there.

    No kernel here needs any; what else is compiled and multiplies matrices still loads it.
    """
    name = "scipy.linalg"
    hidden: Any = {} if name in sys.modules else {name: None}
    sys.modules.update(hidden)
    try:
        importlib.import_module("numba.np.arraymath")  # which looks for them, at the first kernel otherwise
    finally:
        for one in hidden:
            del sys.modules[one]


def supports(*tensors: Tensor) -> bool:
    """Whether a compiled CPU version can run on these tensors: on the CPU, float32 or float64, no graph to be kept."""
    if not available() or not is_eager():
        return False
    graph = torch.is_grad_enabled()
    for tensor in tensors:  # one loop, since it is asked at every call of every operation
        if tensor.device.type != "cpu" or (graph and tensor.requires_grad):
            return False
        if tensor.is_floating_point() and tensor.dtype not in _FLOATS:
            return False
    return True


def arrays_of(*tensors: Tensor) -> tuple[np.ndarray, ...]:
    """Tensors as the contiguous arrays that compiled versions take."""
    return tuple(tensor.detach().contiguous().numpy() for tensor in tensors)


def bare(function: FunctionType) -> Any:  # noqa: ANN401  (numba comes without types)
    """Decorator: compile a function that a kernel calls often, without counting references to its arrays.

    Counting costs more than a small function does; so it must not make arrays, only use those that it is given. It is
    not kept on its own, only within the kernel: what is kept of it would outlive a change of another that it calls.
    """
    return inner(_nrt=False)(function)


def inlined(function: FunctionType) -> Any:  # noqa: ANN401  (numba comes without types)
    """Decorator: a `bare` function that becomes part of each that calls it.

    For those that take many arrays and are called in one place: an array is handed over as seven numbers or more.
    """
    return inner(_nrt=False, forceinline=True)(function)


def inner(**options: Any) -> Callable[[FunctionType], Any]:  # noqa: ANN401  (numba's own)
    """Decorator: compile a function that kernels alone call; a third of a kernel's compile time goes into other calls.

    Python cannot call it, and it says so: what would take its arguments from Python or C is not made, nor machine code
    of it by itself (`lean_compiler`).

    Args:
        options: of `numba.njit`.
    """
    import numba

    from sdf.lean_compiler import InnerCompiler, quick_to_look_up

    asked = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "pipeline_class": InnerCompiler, **options}

    def make(function: FunctionType) -> Any:  # noqa: ANN401
        compiler: Any = numba.njit  # whose stubs leave these out
        made = quick_to_look_up(compiler(error_model="numpy", **asked)(function))

        def add_overload(result: Any) -> None:  # noqa: ANN401
            made.overloads[tuple(result.signature.args)] = result

        def refuse(*_: object, **__: object) -> None:
            raise TypeError(
                f"Expected {function.__name__} to be called in a kernel: `interpreted` gives one for Python"
            )

        made.add_overload, made._compile_for_args = add_overload, refuse
        return made

    return make


def interpreted(function: Any) -> Any:  # noqa: ANN401  (numba comes without types)
    """A `bare` function as Python runs it, with those of its file: for calls that are too few to compile it for."""
    names = dict(function.py_func.__globals__)
    for name, value in names.items():
        if getattr(value, "py_func", None) is not None and value.py_func.__module__ == function.py_func.__module__:
            names[name] = FunctionType(value.py_func.__code__, names, name, value.py_func.__defaults__)
    return names[function.py_func.__name__]


class Kernel:
    """A function over NumPy arrays that numba compiles, run by as many threads as its work is worth.

    It is compiled once, without any threading: threads run the same code on parts of its loop, so that results are the
    same to the bit for any number of them. Compiled code is kept in the user's cache (`kernel_cache`).

    Args:
        function: what numba compiles. It fills arrays that it is given; its last argument is a part, and its outermost
            loop is over `part_numba.indices(part, count)`, of iterations that do not depend on each other.
        fast: let sums be reordered and products be added in one go, so that loops become vector instructions;
            NaN, infinity and the smallest numbers stay what they are.
    """

    def __init__(self, function: FunctionType, *, fast: bool = False) -> None:
        import numba

        from sdf.kernel_cache import KernelCache
        from sdf.lean_compiler import KernelCompiler, quick_to_look_up

        compiler: Any = numba.njit
        options: dict[str, Any] = {"error_model": "numpy", "fastmath": _FAST if fast else False, "nogil": True}
        self._label = function.__name__.strip("_")
        self._compiled: Any = quick_to_look_up(
            compiler(**options, no_cfunc_wrapper=True, pipeline_class=KernelCompiler)(
                _renamed(function, f"{function.__name__}_{_stamp(function)}")
            )
        )
        self._compiled._cache = KernelCache(self._compiled.py_func)
        self._announced = False

    def __call__(self, *arguments: Any) -> None:  # noqa: ANN401  (whatever the function takes)
        """Run it."""
        if self._announced:
            divide(partial(self._compiled, *arguments), count())
            return
        self._announce()
        collecting = gc.isenabled()
        gc.disable()  # compiling makes millions of objects, to look through which takes a tenth of its time
        try:
            divide(partial(self._compiled, *arguments), count())
        finally:
            if collecting:
                gc.enable()

    @property
    def kept(self) -> bool:
        """Whether compiled code of it is kept."""
        name = self._compiled.py_func.__name__
        return next(Path(self._compiled.stats.cache_path).glob(f"*.{name}-*.nbi"), None) is not None

    def _announce(self) -> None:
        """Say once that compiling takes a while, where nothing compiled is kept yet."""
        self._announced = True
        if not self.kept:
            sys.stderr.write(f"rumi: compiling {self._label} for this processor (seconds, once)\n")
            sys.stderr.flush()


def _stamp(function: FunctionType) -> str:
    """Digest of what a function's compiled code hangs on.

    The function's file, those of its building blocks, this one and the compiler's; and the numbers that these import
    from other files, which compiling freezes.
    """
    met = {function.__module__}
    waiting = [function.__module__]
    while waiting:
        for value in list(vars(sys.modules[waiting.pop()]).values()):
            module = getattr(value, "__module__", None)
            if isinstance(module, str) and module.endswith("_numba") and module in sys.modules and module not in met:
                met.add(module)
                waiting.append(module)
    digest = hashlib.sha256()
    for module in sorted({*met, __name__, "sdf.lean_compiler"}):
        digest.update(Path(str(sys.modules[module].__file__)).read_bytes())
        numbers = {name: value for name, value in vars(sys.modules[module]).items() if isinstance(value, int | float)}
        digest.update(repr(sorted(numbers.items())).encode())
    return digest.hexdigest()[:16]


def _renamed(function: FunctionType, name: str) -> FunctionType:
    """The same function by another name, under which its compiled code is kept apart."""
    copy = FunctionType(function.__code__, function.__globals__, name, function.__defaults__, function.__closure__)
    copy.__qualname__, copy.__module__ = name, function.__module__
    return copy
