import math

import pytest
import torch

from sdf.check import FAR, check_finite, check_shape, keep_within_reach


def test_message_names_argument_expectation_and_what_came():
    with pytest.raises(ValueError, match=r"^Expected points to have shape \(\*b, M, 3\), got \(5, 2\)$"):
        check_shape("points", torch.zeros(5, 2), "(*b, M, 3)", last=(3,))


@pytest.mark.parametrize(
    ("shape", "text", "last", "fits"),
    [
        ((3,), "(*b, 3)", (3,), True),
        ((2, 0, 3), "(*b, 3)", (), True),
        ((), "(*b, 3)", (), False),
        ((3,), "(*b, M, 3)", (3,), False),
        ((4, 3), "(*b, M, 3)", (), True),
        ((4, 4), "(4, 4)", (), True),
        ((1, 4, 4), "(4, 4)", (), False),
        ((2, 2), "(2, 3)", (), False),
        ((5, 6, 7), "(X, Y, Z)", (), True),
        ((5, 6), "(X, Y, Z, *C)", (), False),
        ((5, 6, 7, 2), "(X, Y, Z, *C)", (), True),
        ((9,), "(*b)", (), True),
        ((), "()", (), True),
        ((1,), "()", (), False),
        ((7, 2), "(*b, N)", (3,), False),
    ],
)
def test_shapes(shape, text, last, fits):
    if fits:
        check_shape("x", torch.zeros(shape), text, last)
    else:
        with pytest.raises(ValueError, match="Expected x to have shape"):
            check_shape("x", torch.zeros(shape), text, last)


def test_not_a_tensor(no_shape_check):
    with pytest.raises(ValueError, match=r"Expected points to be a tensor of shape \(\*b, 3\), got list"):
        check_shape("points", [1.0, 2.0, 3.0], "(*b, 3)")


def test_finite():
    points = torch.zeros(4, 3)
    check_finite("points", points)
    check_finite("points", torch.zeros(0, 3))
    points[1, 2], points[3, 0] = math.nan, math.inf
    with pytest.raises(ValueError, match=r"Expected points to be finite, got 2 of 12 .* nan, at index \(1, 2\)"):
        check_finite("points", points)


def test_replaced_coordinates_are_far_and_finite(dtype):
    raw = torch.tensor([math.nan, math.inf, -math.inf, 0.25, -1e30], dtype=dtype)
    assert keep_within_reach(raw).tolist() == [FAR, FAR, -FAR, 0.25, -FAR]
