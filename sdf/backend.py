"""Dispatch registry: which version of each hot operation runs.

Every hot operation is one public function. Its plain torch version, named "torch", is the definition and takes any
tensors; a quicker one may stand beside it and says which tensors it supports, and which it suits. The one registered
last that suits the tensors at hand runs, unless a version is forced by the environment variable RUMI_BACKEND or by
`force`, which may be any that supports them.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

import torch
from torch import Tensor

VARIABLE = "RUMI_BACKEND"
PLAIN = "torch"

_Function = TypeVar("_Function", bound=Callable[..., Any])
_VERSIONS: dict[str, dict[str, tuple[Callable[..., Any], Callable[..., bool], Callable[..., bool]]]] = {}
_forced: ContextVar[str | None] = ContextVar("forced", default=None)
_observed: ContextVar[dict[str, str] | None] = ContextVar("observed", default=None)


def register(
    op: str,
    version: str = PLAIN,
    supports: Callable[..., bool] = lambda *tensors: True,
    suits: Callable[..., bool] = lambda *tensors: True,
) -> Callable[[_Function], _Function]:
    """Decorator that enters a function as one version of an operation.

    Args:
        op: the operation's public name.
        version: this version's name; register "torch", the plain one, first.
        supports: takes the tensors given to `dispatch`; whether this version can run on them.
        suits: likewise, whether it is to run on tensors that it supports without being forced.
    """

    def enter(function: _Function) -> _Function:
        _VERSIONS.setdefault(op, {})[version] = (function, supports, suits)
        return function

    return enter


def versions(op: str) -> list[str]:
    """Names of an operation's versions, the plain one first."""
    if op not in _VERSIONS:
        raise ValueError(f"Expected one of the operations {sorted(_VERSIONS)}, got {op!r}")
    return list(_VERSIONS[op])


def dispatch(op: str, *tensors: Tensor) -> Callable[..., Any]:
    """The version of an operation that runs on these tensors.

    A forced version that an operation does not have leaves that operation plain. Where `torch.compile` or
    `torch.export` traces, the plain version runs, whatever is forced.

    Raises:
        ValueError: if the operation is unknown, no operation has the forced version, or it can't take the tensors.
    """
    if torch.compiler.is_compiling():
        return _VERSIONS[op][PLAIN][0]
    names = versions(op)
    name = _forced.get() or os.environ.get(VARIABLE) or None
    if name is not None:
        _check(name)
        name = name if name in names else PLAIN
        function, supports, _ = _VERSIONS[op][name]
        if not supports(*tensors):
            what = ", ".join(f"{t.dtype} on {t.device}{', with graph' * t.requires_grad}" for t in tensors)
            raise ValueError(f"Expected tensors that the forced version {name!r} of {op} supports, got {what}")
        return _noted(op, name, function)
    for name in reversed(names):
        function, supports, suits = _VERSIONS[op][name]
        if supports(*tensors) and suits(*tensors):
            return _noted(op, name, function)
    raise ValueError(f"Expected a version of {op} for these tensors, got none among {names}")


@contextmanager
def force(version: str) -> Iterator[None]:
    """Within the block every operation that has this version runs it."""
    _check(version)
    token = _forced.set(version)
    try:
        yield
    finally:
        _forced.reset(token)


@contextmanager
def observed() -> Iterator[dict[str, str]]:
    """Within the block, enters the version that was dispatched last for each operation into the dict it gives."""
    ran: dict[str, str] = {}
    token = _observed.set(ran)
    try:
        yield ran
    finally:
        _observed.reset(token)


def _noted(op: str, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    ran = _observed.get()
    if ran is not None:
        ran[op] = name
    return function


def _check(version: str) -> None:
    known = sorted({name for table in _VERSIONS.values() for name in table} | {PLAIN})
    if version not in known:
        raise ValueError(f"Expected one of the backends {known} ({VARIABLE} or force), got {version!r}")
