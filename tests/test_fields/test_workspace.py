"""The workspace lattice: where its points are, and fields on it."""

import pytest
import torch

from rumi.fields.workspace import Workspace

PAPER = torch.tensor([[0.0, -0.4, 0.0], [0.8, 0.4, 0.2]])


def test_papers_planar_and_solid_lattices() -> None:
    planar = Workspace.from_bounds(PAPER, 0.01, planar_height=0.045)
    assert planar.shape == (81, 81, 1)
    assert planar.planar
    assert torch.equal(planar.points[:, 2], torch.full((6561,), 0.045))
    solid = Workspace.from_bounds(PAPER, 0.02)
    assert solid.shape == (41, 41, 11)
    assert len(solid) == 41 * 41 * 11
    torch.testing.assert_close(solid.bounds, PAPER)


def test_points_are_the_grids_own_nodes(dtype: torch.dtype) -> None:
    workspace = Workspace.from_bounds(PAPER.to(dtype), 0.1)
    values = workspace.points @ torch.tensor([1.0, -2.0, 3.0], dtype=dtype)
    grid = workspace.grid(values)
    torch.testing.assert_close(grid.centers().reshape(-1, 3), workspace.points)
    torch.testing.assert_close(grid.interpolate(workspace.points), values)
    # an affine field is what its interpolation is
    inner = workspace.points[0] + 0.37 * (workspace.points[-1] - workspace.points[0])
    torch.testing.assert_close(grid.interpolate(inner), inner @ torch.tensor([1.0, -2.0, 3.0], dtype=dtype))


def test_zeros_channels_and_one_cell() -> None:
    workspace = Workspace.from_bounds(torch.tensor([[0.1, 0.2, 0.3], [0.1, 0.2, 0.3]]), 0.01)
    assert workspace.shape == (1, 1, 1)
    assert workspace.zeros(3).values.shape == (1, 1, 1, 3)
    assert not workspace.zeros().values.any()


def test_moves_between_dtypes() -> None:
    workspace = Workspace.from_bounds(PAPER, 0.2).to(torch.float64)
    assert workspace.points.dtype == torch.float64
    assert workspace.shape == (5, 5, 2)


def test_refuses_what_is_no_lattice() -> None:
    with pytest.raises(ValueError, match="spacing"):
        Workspace.from_bounds(PAPER, 0.0)
    with pytest.raises(ValueError, match="swap the corners"):
        Workspace.from_bounds(PAPER.flip(0), 0.1)
    with pytest.raises(ValueError, match="bounds to be finite"):
        Workspace.from_bounds(PAPER * torch.inf, 0.1)
    with pytest.raises(ValueError, match=r"shape \(50, \*c\)"):
        Workspace.from_bounds(PAPER, 0.2).grid(torch.zeros(7))


@pytest.mark.parametrize("spacing", [0.0005, 0.001, 0.007])
def test_rounded_corners_lose_no_points(spacing):
    generator = torch.Generator().manual_seed(0)
    for _ in range(200):
        cells = torch.randint(0, 60, (3,), generator=generator)
        low = (4.0 * torch.rand(3, generator=generator) - 2.0).float()
        high = (low.double() + cells * spacing).float()
        made = Workspace.from_bounds(torch.stack((low, torch.maximum(low, high))), spacing)
        assert made.shape == tuple((cells + 1).tolist())


@pytest.mark.parametrize("spacing", [float("inf"), float("nan"), 1e-9])
def test_lattices_that_cannot_be_are_refused(spacing):
    with pytest.raises(ValueError, match="spacing"):
        Workspace.from_bounds(torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]), spacing)
