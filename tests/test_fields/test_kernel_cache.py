"""Kernels give the same bits whether a process compiles them or loads them from the cache."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

FIELDS = """
import hashlib
import torch
from rumi.fields.information import information_field
from sdf import se3
from sdf.grid_sdf import GridSDF
from sdf.primitives import Box

random = torch.Generator().manual_seed(0)
sdf = GridSDF.from_sdf(Box((0.06, 0.04, 0.05)), 0.004)
poses = se3.from_planar(0.03 * torch.randn(100, 3, generator=random))
points = 0.06 * torch.randn(4000, 3, generator=random)
weights = torch.randn(100, generator=random).log_softmax(-1)
for mode in ("sensor_mi", "surrogate", "reverse_kl", "forward_kl"):
    found = information_field(sdf, poses, weights, points, mode=mode)
    print(mode, hashlib.sha256(found.information.numpy().tobytes()).hexdigest())
"""


@pytest.mark.slow
def test_fields_of_a_process_that_compiles_are_those_of_one_that_does_not(tmp_path: Path) -> None:
    place = {"XDG_CACHE_HOME": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "numba")}
    told = [
        subprocess.run(
            [sys.executable, "-c", FIELDS], env={**os.environ, **place}, capture_output=True, text=True, check=True
        ).stdout
        for _ in range(2)
    ]
    assert told[0] == told[1]
    assert len(told[0].splitlines()) == 4
