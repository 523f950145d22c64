"""The exponential and the logarithm of the fused fields against the library's, over all that they are asked for."""

import numpy as np
import pytest

from rumi.fields.information_numba import _exp_minus, _log
from sdf.compiled import Kernel
from sdf.part_numba import indices


def _both(u, x, exponential, logarithm, part):
    for i in indices(part, len(u)):
        exponential[i] = _exp_minus(u[i])
        logarithm[i] = _log(x[i])


both = Kernel(_both, fast=True)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_exponential_and_logarithm(dtype):
    tiny, ulp = np.finfo(dtype).tiny, np.finfo(dtype).eps
    u = np.concatenate((np.linspace(0.0, 87.0, 100_001), np.logspace(-12, 1, 1001), [0.0])).astype(dtype)
    x = np.concatenate((np.linspace(1e-3, 1.0, 100_001), np.logspace(-37, 0, 1001), [tiny])).astype(dtype)
    exponential, logarithm = np.empty_like(u), np.empty_like(x)
    both(u, x, exponential, logarithm)
    expected = np.exp(-u.astype(np.float64))
    assert np.abs(exponential / expected - 1.0).max() < 4 * ulp
    assert exponential[-1] == 1.0
    expected = np.log(x.astype(np.float64))
    assert np.abs(logarithm - expected).max() < 4 * ulp * np.abs(expected).max()
    close = x > 0.7  # where what matters is small, it is right relative to its size
    assert (np.abs(logarithm - expected)[close] <= 4 * ulp * np.abs(expected[close])).all()
    assert logarithm[x == 1.0].tolist() == [0.0] * int((x == 1.0).sum())


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_what_is_far_off_counts_for_nothing(dtype):
    u = np.array([88.0, 1e3, 1e8, np.inf], dtype)
    exponential, logarithm = np.empty_like(u), np.empty_like(u)
    both(u, np.ones_like(u), exponential, logarithm)
    assert (exponential >= 0).all()
    assert (exponential < 1e-37).all()
