"""The same sweeps with their operations on another device: inputs go there, results come back, references stay."""

import copy
from dataclasses import replace
from functools import cache
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from tests.stress.sweep import SWEEPS, Inputs, Sweep

_Module = TypeVar("_Module", bound=nn.Module)

THERE = (
    *("se3-", "beliefs-", "distances-table", "distances-closed", "distances-not-finite", "distances-posed"),
    *(
        "distances-discrepancy",
        "fields-",
        "entropy-",
        "likelihoods-contact",
        "likelihoods-semantics",
    ),
    *("likelihoods-log-surface", "likelihoods-nll", "planning-information-cost"),
)
"""Beginnings of the names of the sweeps whose operations run wherever their inputs are."""
_HERE = ("se3-exp-gradient", "beliefs-resampling", "entropy-channel-capacity")
"""Those of them that are about numbers of Python, or walk through them one by one."""


def on_device(sweep: Sweep, device: torch.device) -> Sweep:
    """A sweep that is carried out there, and whose results are judged here."""

    def operation(inputs: Inputs) -> Any:  # noqa: ANN401  (whatever it gives)
        with device:
            return _moved(sweep.operation(_moved(inputs, device)), torch.device("cpu"))

    return replace(sweep, name=f"{sweep.name.removesuffix('-torch')}-{device.type}", operation=operation)


def sweeps_there() -> list[Sweep]:
    """Of those that are entered, the ones that can be carried out on another device: none of fused versions."""
    return [
        sweep
        for name, sweep in SWEEPS.items()
        if name.startswith(THERE) and not name.startswith(_HERE) and not name.endswith("-numba") and not sweep.slow
    ]


def here(module: _Module) -> _Module:
    """A module that several operations share, on the device that they run on."""
    device = torch.get_default_device()
    return module if device.type == "cpu" else _copied(module, device)


@cache
def _copied(module: Any, device: torch.device) -> Any:  # noqa: ANN401  (the module, as it came)
    return copy.deepcopy(module).to(device)


def _moved(value: Any, device: torch.device) -> Any:  # noqa: ANN401  (whatever holds tensors)
    """Tensors, and what is made of them, on a device."""
    if isinstance(value, Tensor):
        return value.to(device)
    if isinstance(value, dict):
        return {name: _moved(one, device) for name, one in value.items()}
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*(_moved(one, device) for one in value))
    if isinstance(value, list | tuple):
        return type(value)(_moved(one, device) for one in value)
    return value
