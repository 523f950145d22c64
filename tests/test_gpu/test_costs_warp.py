"""Costs of trajectories by their version for a GPU, against the definition, over the inputs of the family."""

import math

import pytest
import torch

from rumi.dynamics.base import PushRollouts, duplicates
from rumi.planning.costs import information_cost
from rumi.planning.objective import TrajectoryCost
from sdf import backend, gpu
from sdf.voxel_grid import VoxelGrid

pytest.importorskip("warp")

CASES = ("planar", "turning", "space", "far", "no-information", "no-points", "no-paths", "one-cell")


def scene(name, dtype, generator):
    """Information, reachability, sensing points and rollouts; places are multiples of 1/64, on no cell's border."""

    def grid(*shape):
        return torch.randint(0, 16, shape, generator=generator).to(dtype) / 16

    def places(*shape, reach):
        return torch.randint(-reach, reach + 1, shape, generator=generator).to(dtype) / 64

    shape = {"space": (9, 8, 5), "one-cell": (1, 1, 1)}.get(name, (12, 11, 1))
    origin = torch.tensor([-0.2, -0.2, 0.0], dtype=dtype) + 1 / 256
    information, reachability = (VoxelGrid(grid(*shape), origin, 1 / 32) for _ in range(2))
    if name == "no-information":
        information = information.with_values(torch.zeros_like(information.values))
    points = torch.cat((places(14, 2, reach=5), torch.zeros(14, 1, dtype=dtype)), -1)
    if name == "space":
        points[:, 2] = places(14, reach=3)
    if name == "no-points":
        points = points[:0]
    samples = 0 if name == "no-paths" else 6
    width = 4 if name == "space" else 3
    configurations = places(samples, 3, 5, width, reach=16)
    configurations[..., -1] = (math.pi / 2) * torch.randint(-2, 3, configurations.shape[:-1], generator=generator)
    displacements = torch.cat((places(samples, 3, 5, 2, reach=6), torch.zeros(samples, 3, 5, 1, dtype=dtype)), -1)
    if name == "far":
        configurations[0, 0, 2:, :2] = 1e6
        displacements[1, :, 3:, 0] = -1e6
    contact = torch.ones(samples, 3, 4, dtype=torch.bool)
    rollouts = PushRollouts(configurations, displacements, contact, 1.0, duplicates(contact))
    if name == "turning":
        turns = 0.7 * torch.randn(samples, 3, 5, dtype=dtype, generator=generator)
        turns[0] = 0.0
        rollouts = rollouts._replace(turns=turns, pivot=torch.tensor([0.03, -0.02], dtype=dtype))
    return information, reachability, points, rollouts


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize(("scales", "discount", "normalise"), [((1.0, 4.0), 0.9, True), ((0.5, 0.0), 1.0, False)])
def test_equal_to_the_definition(name, scales, discount, normalise, dtype, generator):
    information, reachability, points, rollouts = scene(name, dtype, generator)
    if name == "turning":  # a turned point may round to either side of a cell's border: what is in reach alone
        scales = (0.0, 4.0)
    found = {}
    for version in (backend.PLAIN, gpu.VERSION):
        with backend.force(version):
            cost = TrajectoryCost(
                information,
                reachability,
                points,
                information_scale=scales[0],
                reachability_scale=scales[1],
                information_discount=discount,
                normalise=normalise,
                spatial=name == "space",
            )
            found[version] = cost(rollouts)
    assert found[gpu.VERSION].shape == rollouts.displacements.shape[:1]
    assert bool(found[gpu.VERSION].isfinite().all())
    atol = 200 * torch.finfo(dtype).eps
    torch.testing.assert_close(found[gpu.VERSION], found[backend.PLAIN], atol=atol, rtol=atol)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", [name for name in CASES if name != "turning"])
def test_what_paths_gather_is_equal_to_the_definition(name, dtype, generator):
    information, _, points, rollouts = scene(name, dtype, generator)
    paths = (x[:, :, 1:].flatten(0, 1) for x in (rollouts.configurations, rollouts.displacements))
    configurations, displacements = paths
    found = {}
    for version in (backend.PLAIN, gpu.VERSION):
        with backend.force(version):
            found[version] = information_cost(information, points, configurations, displacements, discount=0.8)
    atol = 200 * torch.finfo(dtype).eps
    torch.testing.assert_close(found[gpu.VERSION], found[backend.PLAIN], atol=atol, rtol=atol)
