"""The hints of the packages are enforced in every test, for a function's first calls and ever fewer later ones."""

import os

import jaxtyping
import pytest
import torch

from sdf import se3


@pytest.mark.skipif("RUMI_NO_SHAPE_CHECK" in os.environ, reason="hints are not enforced")
@pytest.mark.parametrize("turn", ["first", "second"])
def test_a_wrong_shape_is_refused_in_each_test(turn):
    checked = []
    for _ in range(16):
        try:
            se3.inverse(torch.zeros(3, 3))
        except Exception as error:
            checked.append(isinstance(error, jaxtyping.TypeCheckError))
        else:
            checked.append(False)
    assert [call for call, was in enumerate(checked, 1) if was] == [1, 2, 3, 4, 8, 16]
