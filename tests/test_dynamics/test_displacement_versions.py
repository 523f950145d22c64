"""The versions of the displacement model agree, in a plane and in space, also where it is odd."""

from typing import get_args

import pytest
import torch

from rumi.dynamics.contact import ContactField
from rumi.dynamics.displacement_rollouts import DisplacementRollouts, DisplacementSettings, Hazard
from sdf import backend
from sdf.voxel_grid import VoxelGrid
from tests.fixtures.push_fields import F64, begin, make_tool, spread_field

# every test of this file holds for the plain and for the compiled versions
pytestmark = [
    pytest.mark.usefixtures("version"),
    pytest.mark.parametrize("version", ["torch", "numba", "warp"], indirect=True),
]


@pytest.mark.parametrize("hazard", get_args(Hazard))
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_versions_agree(hazard: Hazard, dtype: torch.dtype, generator: torch.Generator) -> None:
    field, tool = spread_field(dtype, generator), make_tool(dtype, reaching=True, spacing=0.006)
    model = DisplacementRollouts(field, tool, DisplacementSettings(hazard=hazard))
    controls = (2.0 * torch.rand(200, 10, 3, generator=generator) - 1.0).to(dtype)
    start = torch.tensor([0.28, 0.0, 0.1], dtype=dtype)
    draws = model.draw(200, 5, 10, generator=generator)
    found = model.rollout_drawn(start, controls, draws)
    with backend.force("torch"):
        plain = model.rollout_drawn(start, controls, draws)
    same = (found.contact == plain.contact).all(-1)
    same &= (found.displacements - plain.displacements).abs().amax((-1, -2)) < 1e-5
    same &= (found.configurations - plain.configurations).abs().amax((-1, -2)) < 1e-5
    # in float32 the last digit of a probability may fall on the other side of a number that was drawn
    assert float(same.double().mean()) > (0.995 if dtype == torch.float32 else 0.9999)
    assert 0.2 < float(found.touched.double().mean()) < 0.98


@pytest.mark.parametrize("spatial", [False, True])
@pytest.mark.parametrize("case", ["no contact", "one particle", "inside", "far", "standing still", "held by the arm"])
def test_versions_agree_also_where_it_is_odd(case: str, spatial: bool, generator: torch.Generator) -> None:
    field = spread_field(F64, generator, spatial, 1 if case == "one particle" else 5)
    start, size = begin(F64, spatial), 4 if spatial else 3
    tool = make_tool(F64, reaching=case == "held by the arm", spacing=0.03, spatial=spatial)
    controls = 1.2 * torch.rand(8, 4, size, generator=generator, dtype=F64) - 0.4
    if case == "no contact":
        start = start - torch.tensor([2.0, 1.0, 0.0, 0.0], dtype=F64)[:size]
    if case == "inside":
        start[:2] = torch.tensor([0.4, 0.0])
    if case == "far":
        shift = torch.tensor([1e3, -400.0, 0.0], dtype=F64)
        field = ContactField(*(type(grid)(grid.values, grid.origin + shift, grid.spacing) for grid in _grids(field)))
        start[:2] += shift[:2]
        tool.bounds[:, :2] *= 1e3
    if case == "standing still":
        controls = torch.zeros_like(controls)
    model = DisplacementRollouts(field, tool)
    draws = model.draw(8, 3, 4, generator=generator)
    found = model.rollout_drawn(start, controls, draws)
    with backend.force("torch"):
        plain = model.rollout_drawn(start, controls, draws)
    assert bool(plain.touched.any()) == (case not in ("no contact", "standing still"))
    for name in ("configurations", "displacements", "contact"):
        torch.testing.assert_close(getattr(found, name), getattr(plain, name), atol=1e-8, rtol=0)


def _grids(field: ContactField) -> tuple[VoxelGrid, VoxelGrid]:
    return field.probability, field.normal


@pytest.mark.parametrize("hazard", get_args(Hazard))
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_versions_agree_in_space(hazard: Hazard, dtype: torch.dtype, generator: torch.Generator) -> None:
    field = spread_field(dtype, generator, True)
    for reaching, horizon, count in ((True, 8, 60), (False, 1, 1), (False, 3, 0)):
        model = DisplacementRollouts(
            field, make_tool(dtype, reaching=reaching, spacing=0.03, spatial=True), DisplacementSettings(hazard=hazard)
        )
        start = torch.tensor([0.30, 0.0, 0.1, 0.0], dtype=dtype)
        controls = torch.rand(count, horizon, 4, generator=generator, dtype=dtype) * 2 - 1
        draws = model.draw(count, 3, horizon, generator=generator)
        with backend.force("torch"):
            plain = model.rollout_drawn(start, controls, draws)
        result = model.rollout_drawn(start, controls, draws)
        # where a number that decides is hit within rounding, rollouts part
        same = (result.configurations - plain.configurations).abs().amax((-1, -2)) < 1e-4
        assert count == 0 or float(same.double().mean()) > (0.95 if dtype == torch.float32 else 0.999)
        torch.testing.assert_close(result.displacements[same], plain.displacements[same], atol=1e-4, rtol=0)
        assert torch.equal(result.contact[same], plain.contact[same])
