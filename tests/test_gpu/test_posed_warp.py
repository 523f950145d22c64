"""Distances at many poses by their version for a GPU, against the definition, over the inputs of the family."""

import math

import pytest
import torch

from sdf import backend, gpu, se3
from sdf.grid_sdf import GridSDF
from sdf.posed import posed_distance, posed_query
from sdf.primitives import Mug

pytest.importorskip("warp")

EPSILONS = 40  # units in the last place of the farthest coordinate that a sum in another order may move a result by


def poses_and_points(name, dtype, generator):
    def normal(*shape):
        return torch.randn(*shape, dtype=dtype, generator=generator)

    poses, points = se3.exp(0.1 * normal(5, 6)), 0.2 * normal(60, 3)
    if name == "batch":
        return se3.exp(0.1 * normal(2, 1, 4, 6)), 0.2 * normal(3, 30, 3)
    if name == "upright":
        points[:, 2] = 0.045
        return se3.from_planar(0.1 * normal(5, 3), 0.013), points
    if name == "far":
        points[:20] *= 1e3
        points[0, 0], points[1, 1], points[2, 2] = math.nan, math.inf, -math.inf
    shift = {"one": (1, 60), "no-poses": (0, 60), "no-points": (5, 0)}.get(name, (5, 60))
    return poses[: shift[0]], points[: shift[1]]


@pytest.fixture(scope="module", params=[0.25, 0.0], ids=["outer", "fine"])
def grid(request):
    return GridSDF.from_sdf(Mug(), spacing=0.006, outer=request.param)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["some", "batch", "upright", "far", "one", "no-poses", "no-points"])
def test_equal_to_the_definition(grid, name, dtype, generator):
    poses, points = poses_and_points(name, dtype, generator)
    table = grid.to(dtype)
    found = {}
    for version in (backend.PLAIN, gpu.VERSION):
        with backend.force(version), backend.observed() as ran:
            found[version] = (posed_distance(table, poses, points), *posed_query(table, poses, points))
        assert set(ran.values()) == {version}
    eps = EPSILONS * torch.finfo(dtype).eps
    for plain, own, unit in zip(found[backend.PLAIN], found[gpu.VERSION], (1.0, 1.0, 500.0), strict=True):
        assert own.shape == plain.shape and own.dtype == dtype
        bound = eps * unit * plain.abs().clamp_min(1.0) if unit == 1.0 else eps * unit
        assert bool(((own - plain).abs() <= bound).all())
