"""Kernels: the same for any number of threads, and announced while they are compiled for the first time."""

from pathlib import Path

import numba
import numpy as np
import pytest
import torch

from sdf import fused


def _squares(values, result):
    for index in numba.prange(len(values)):
        result[index] = values[index] ** 2


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize("count", [1, 2])
def test_kernel_is_announced_once_and_the_same_for_any_threads(count, threads, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    kernel = fused.Kernel(_squares)
    threads(count)
    values = np.arange(100.0)
    for _ in range(2):
        result = np.empty(100)
        kernel(values, result)
        np.testing.assert_array_equal(result, values**2)
    assert capsys.readouterr().err.count("compiling squares") == 1
    assert list(Path(tmp_path).rglob("*.nbi"))
    # what is kept is not compiled, nor announced, again
    fused.Kernel(_squares)(values, np.empty(100))
    assert capsys.readouterr().err == ""


def test_what_a_fused_version_can_take():
    plain = torch.zeros(3)
    assert fused.supports(plain, torch.zeros(2, dtype=torch.long))
    assert not fused.supports(plain.requires_grad_())
    with torch.no_grad():
        assert fused.supports(plain)
    assert not fused.supports(torch.zeros(3, dtype=torch.float16))
    assert not fused.supports(torch.zeros(3, device="meta"))
