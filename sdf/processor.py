"""Processor identification: the instruction sets by which the libraries choose code that may round otherwise."""

import hashlib
import platform
from functools import cache
from pathlib import Path
from typing import NamedTuple

import torch

from sdf import compiled


class Processor(NamedTuple):
    """What a result to the bit rests on, of the machine that it comes from; strings, as records keep them.

    Attributes:
        model: what it calls itself, such as "AMD EPYC 7B13".
        torch: the capability that torch's kernels are chosen by, such as "AVX2"; "DEFAULT" uses none.
        numba: the name that kernels are compiled for, such as "znver3"; "generic" is any; empty without numba.
        features: digest of the instructions that they may use; empty without numba.
    """

    model: str
    torch: str
    numba: str
    features: str


def processor() -> Processor:
    """This process's, as emulated by ATEN_CPU_CAPABILITY, NUMBA_CPU_NAME and NUMBA_CPU_FEATURES where they are set."""
    name, features = _compiled_for()
    return Processor(_model(), torch.backends.cpu.get_cpu_capability(), name, features)


@cache
def _compiled_for() -> tuple[str, str]:
    """Name of the processor and a digest of its instructions, by which what numba compiles is kept apart."""
    if not compiled.available():
        return "", ""
    from numba.core.registry import cpu_target

    _, name, features = cpu_target.target_context.codegen().magic_tuple()
    return str(name), hashlib.sha256(str(features).encode()).hexdigest()[:8]


@cache
def _model() -> str:
    listing = Path("/proc/cpuinfo")
    if listing.is_file():
        for line in listing.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith(("model name", "Hardware", "cpu model")):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
