"""The processor's name, and that what is kept of one is not taken for another's."""

import os
import subprocess
import sys

import pytest
import torch

from sdf.cache import content_key
from sdf.processor import processor

SAYS = (
    "from sdf.cache import content_key; from sdf.processor import processor; print(*processor()[1:], content_key('a'))"
)


def test_it_says_what_kernels_are_chosen_by():
    pytest.importorskip("numba")
    found = processor()
    assert found.model and found.numba and all(isinstance(value, str) for value in found)
    assert found.torch == torch.backends.cpu.get_cpu_capability()


def test_an_emulated_one_is_named_and_keeps_its_own():
    """Compiled kernels are kept apart by numba itself, tables and the like by `content_key`."""
    pytest.importorskip("numba")
    emulated = {"ATEN_CPU_CAPABILITY": "default", "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
    done = subprocess.run(
        [sys.executable, "-c", SAYS], env={**os.environ, **emulated}, capture_output=True, text=True, check=True
    )
    torch_for, numba_for, features, key = done.stdout.split()
    assert (torch_for, numba_for) == ("DEFAULT", "generic")
    assert (key == content_key("a")) == (processor()[1:] == (torch_for, numba_for, features))
