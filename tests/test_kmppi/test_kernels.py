"""One suite over every time kernel."""

from typing import get_args

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from kmppi import KERNELS, KernelName, kernel_matrix

ALL = sorted(KERNELS)


def test_table_and_type_agree():
    assert set(KERNELS) == set(get_args(KernelName))


@pytest.mark.parametrize("name", ALL)
def test_one_at_zero_even_and_falling(name):
    ratio = torch.linspace(0.0, 6.0, 200, dtype=torch.float64)
    value = KERNELS[name](ratio)
    assert value[0] == 1.0
    torch.testing.assert_close(KERNELS[name](-ratio), value, rtol=0, atol=0)
    assert (value.diff() <= 1e-15).all()
    assert value[-1] < 1e-3


@pytest.mark.parametrize("name", ALL)
@given(
    times=st.lists(st.integers(-40, 40), min_size=1, max_size=12, unique=True),
    scale=st.floats(0.2, 4.0),
)
def test_positive_semidefinite(name, times, scale):
    at = torch.tensor(times, dtype=torch.float64)
    gram = kernel_matrix(name, at, at, scale)
    torch.testing.assert_close(gram, gram.T, rtol=0, atol=0)
    assert torch.linalg.eigvalsh(gram).min() > -1e-12 * len(times)


def test_rbf_and_matern_in_closed_form():
    at = torch.tensor([0.0, 3.0], dtype=torch.float64)
    zero = torch.zeros(1, dtype=torch.float64)
    root3, root5 = 3.0**0.5 * 1.5, 5.0**0.5 * 1.5
    expected = {
        "rbf": 2.718281828459045 ** (-9.0 / 8.0),
        "matern32": (1 + root3) * 2.718281828459045**-root3,
        "matern52": (1 + root5 + root5**2 / 3) * 2.718281828459045**-root5,
        "bspline3": 0.5**3 / 4,
    }
    for name, value in expected.items():
        got = kernel_matrix(name, at, zero, 2.0)
        assert got.shape == (2, 1)
        assert got[1, 0].item() == pytest.approx(value, rel=1e-14)


def test_bspline_is_the_convolution_of_boxes():
    # four boxes of width 1, convolved on a fine lattice, scaled to 1 in the middle
    cells = 400
    box = torch.ones(1, 1, cells, dtype=torch.float64)
    curve = box
    for _ in range(3):
        curve = torch.nn.functional.conv1d(curve, box, padding=cells - 1)
    curve = curve[0, 0] / curve.max()
    ratio = (torch.arange(curve.numel(), dtype=torch.float64) - (curve.numel() - 1) / 2) / cells
    torch.testing.assert_close(KERNELS["bspline3"](ratio), curve, rtol=0, atol=1e-4)


def test_unknown_name_lists_the_known(no_shape_check):
    at = torch.zeros(1, dtype=torch.float64)
    with pytest.raises(ValueError, match="one of rbf, matern32, matern52, bspline3, got 'box'"):
        kernel_matrix("box", at, at, 1.0)
