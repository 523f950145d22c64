"""Float32 tensors stay float32, and nothing breaks, where torch's default is float64, and the other way round."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from rumi import build, preset, run
from rumi.dynamics.along_path import Pusher, push_along_path
from rumi.dynamics.outline import RectangleOutline
from rumi.dynamics.sliding import Sliding
from rumi.fields.workspace import Workspace
from rumi.planning.reach_cost import ReachabilityCost
from rumi.registration.descent import violable_pairs
from sdf import backend, se3
from sdf.grid_sdf import GridSDF
from sdf.primitives import Box
from sdf.sweep import nearest_on_rectangle, sweep_rectangle
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation
from sensors.vision.persistence import Persistence

DTYPES = (torch.float32, torch.float64)


@pytest.fixture(params=DTYPES, ids=str, autouse=True)
def default(request: pytest.FixtureRequest) -> Iterator[torch.dtype]:
    kept = torch.get_default_dtype()
    torch.set_default_dtype(request.param)
    yield request.param
    torch.set_default_dtype(kept)


@pytest.mark.parametrize("kind", DTYPES, ids=str)
def test_what_is_met_on_a_rectangle(kind: torch.dtype) -> None:
    half = torch.tensor([0.05, 0.03], dtype=kind)
    places = torch.tensor([[0.01, -0.02], [0.2, 0.1]], dtype=kind)
    assert {part.dtype for part in nearest_on_rectangle(places, half)} == {kind}
    met = sweep_rectangle(torch.zeros(3, dtype=kind), half, torch.full((2,), 0.2, dtype=kind), places[:1], 0.01)
    assert {part.dtype for part in met[1:]} == {kind}


@pytest.mark.parametrize("kind", DTYPES, ids=str)
@pytest.mark.parametrize("version", ["torch", "numba"])
def test_carrying(kind: torch.dtype, version: str) -> None:
    still = torch.zeros(2, 3, dtype=kind)
    path = torch.tensor([[[0.2, 0.0, 0.0], [0.04, 0.01, 0.0]]], dtype=kind)
    sliding = Sliding(still[0, :2], torch.tensor(0.03, dtype=kind), torch.tensor(0.3, dtype=kind))
    with backend.force(version):
        carried = push_along_path(still, path, Pusher.disc(0.01, still), RectangleOutline((0.05, 0.03)), sliding)
    assert carried.track.dtype == carried.distance.dtype == kind
    assert float(carried.track[:, -1, 0].max()) < -0.015  # it was pushed


@pytest.mark.parametrize("kind", DTYPES, ids=str)
def test_reachable_information(kind: torch.dtype) -> None:
    lattice = Workspace.from_bounds(torch.tensor([[-0.1, -0.1, 0.0], [0.1, 0.1, 0.0]], dtype=kind), 0.02)
    field = lattice.grid(torch.linspace(0.0, 1.0, len(lattice), dtype=kind))
    moved, turns = torch.zeros(2, 3, 3, dtype=kind), torch.full((2, 3), 0.4, dtype=kind)
    assert ReachabilityCost(field, field)(moved, turns, torch.zeros(2, dtype=kind)).dtype == kind


@pytest.mark.parametrize("kind", DTYPES, ids=str)
def test_pairs_of_a_descent(kind: torch.dtype) -> None:
    grid = GridSDF.from_sdf(Box((0.03, 0.04, 0.05)), 0.01).to(kind)
    seen = Observation.of(torch.tensor([[0.031, 0.0, 0.0], [0.3, 0.0, 0.0]], dtype=kind), 0)
    pairs = violable_pairs(Discrepancy(grid, 0.08), se3.identity((1,), dtype=kind), seen, 0.01)
    assert pairs.points.dtype == kind
    assert len(pairs.points) == 1


def test_pixels_that_last() -> None:
    memory, depth = Persistence.start(2, 3), torch.full((2, 3), 0.7)
    for frame in range(8):
        memory, seen = memory.seen(depth, torch.ones(2, 3, dtype=torch.bool), 0.1 * frame)
    assert bool(seen.lasting.all())
    assert seen.depth.dtype == memory.depth.dtype == torch.float32


@pytest.mark.slow
@pytest.mark.parametrize("task", ["mug-0", "box-0"])
def test_a_run(task: str, cache: Path) -> None:
    robot, rummager = build(preset("fast", task=task, seed=1000, steps=2), cache_dir=cache)
    try:
        assert run(robot, rummager, seed=1000, steps=2).stopped_by == "steps"
    finally:
        robot.close()
