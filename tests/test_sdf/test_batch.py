"""Shapes that broadcast, against torch's own."""

import itertools
import subprocess
import sys

import pytest
import torch

from sdf.batch import broadcast_shapes

SHAPES = [(), (1,), (3,), (2, 1), (2, 3), (0,), (4, 1, 1), (1, 0)]


@pytest.mark.parametrize("shapes", [*itertools.combinations_with_replacement(SHAPES, 2), (), ((2, 1), (3,), (1, 1))])
def test_shapes_are_torchs(shapes: tuple[tuple[int, ...], ...]) -> None:
    try:
        expected = torch.broadcast_shapes(*shapes)
    except RuntimeError:
        with pytest.raises(RuntimeError, match="Expected shapes that broadcast"):
            broadcast_shapes(*shapes)
        return
    assert broadcast_shapes(*shapes) == expected


def test_no_library_of_symbols_is_loaded() -> None:
    code = "import sys; from sdf.batch import broadcast_shapes as f; f((2, 1), (3,)); print('sympy' in sys.modules)"
    told = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert told.stdout.strip() == "False"
