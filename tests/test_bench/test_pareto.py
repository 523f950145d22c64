"""Run time against error: what is measured, and what is drawn of it."""

import pytest
import torch

from scripts.bench import pareto_figures
from scripts.bench.estimates import Estimate
from scripts.bench.nearest import NearestGrid
from scripts.bench.pareto_figures import Dot, draw, front
from scripts.store import Store
from sdf.grid_sdf import GridSDF
from sdf.primitives import Sphere


def test_the_front_is_what_nothing_beats():
    dots = [
        Dot({"n": n}, *place) for n, place in enumerate([(1.0, 5.0), (2.0, 5.0), (2.0, 3.0), (3.0, 4.0), (4.0, 1.0)])
    ]
    assert [dot.settings["n"] for dot in front(dots)] == [0, 2, 4]
    assert front([]) == []


def test_nearest_look_up_is_the_value_of_the_nearest_node():
    grid = GridSDF.from_sdf(Sphere(0.03), 0.004, outer=0.08)
    nearest = NearestGrid(grid)
    random = torch.Generator().manual_seed(0)
    points = 0.11 * (2 * torch.rand(500, 3, generator=random) - 1)
    first = torch.tensor(grid.origin)
    snapped = first + torch.round((points - first) / grid.spacing) * grid.spacing
    inside = (points.abs() < 0.045).all(-1)
    torch.testing.assert_close(nearest.distance(points[inside]), grid.distance(snapped[inside]), atol=1e-6, rtol=0)
    # no further off than half a cell's diagonal, of the wide cells outside the fine ones
    off = (nearest.distance(points) - grid.distance(points)).abs()
    assert float(off[inside].max()) <= 0.5 * 3**0.5 * 0.004 + 1e-6
    assert float(off.max()) <= 0.5 * 3**0.5 * 0.020 + 1e-6
    assert float(off.mean()) > 1e-4


def fill(store):
    """What a study might have found, by hand."""
    where = {"situation": "mug-1/view", "points": "x", "threads": 1}
    for particles, error, seconds in ((30, 0.02, 0.002), (100, 0.01, 0.004), (1000, 0.012, 0.05)):
        own = vars(Estimate(particles=particles))
        for seed, more in ((1000, 0.001), (1001, -0.001)):
            figures = {"information_mean": error + more}
            store.measure({"part": "field", **where, "seed": seed, **own}, lambda f=figures: f)
        store.measure({"part": "field-time", **where, **own}, lambda s=seconds: {"seconds": s, "plain_seconds": s})
        shares = {"total_variation": 0.5, "total_variation_yaw": 0.1}
        store.measure({"part": "belief", **where, "seed": 1000, **own}, lambda f=shares: f)
    run = {"task": "mug-0", "preset": "default", "seed": 1000, "steps": None}
    store.measure({"part": "run", **run}, lambda: {"right": True, "actions": 10, "seconds": 3.0, "processor_s": 2.5})


def test_errors_and_times_are_brought_together(tmp_path):
    store = Store(tmp_path / "a.jsonl")
    fill(store)
    fields = {dot.settings["particles"]: dot for dot in pareto_figures.field_dots(store)}
    assert fields[100].error == pytest.approx(0.01)
    assert fields[1000].seconds == 0.05
    assert [dot.settings["particles"] for dot in front(fields.values())] == [30, 100]


def test_figures_are_drawn_of_much_and_of_nothing(tmp_path):
    store = Store(tmp_path / "a.jsonl")
    (empty,) = draw(store, tmp_path / "empty")
    fill(store)
    (path,) = draw(store, tmp_path / "full")
    assert path.stat().st_size > empty.stat().st_size > 1000
