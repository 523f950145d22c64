"""Fields side by side: what is drawn is what was planned over."""

from pathlib import Path

import pytest
import torch

from scripts.reproduce import pictures


def test_a_field_is_seen_from_above():
    """Points in any order, two heights; the larger value of a place shows."""
    points = torch.cartesian_prod(torch.tensor([0.0, 0.1, 0.2]), torch.tensor([-0.1, 0.1]), torch.tensor([0.0, 0.05]))
    values = torch.arange(12.0)
    order = torch.randperm(12, generator=torch.Generator().manual_seed(0))
    field = pictures._field("a", values[order], points[order], 0.5)
    assert field.values.tolist() == [[pytest.approx(v / 11) for v in row] for row in ((1, 3), (5, 7), (9, 11))]
    assert field.bounds == pytest.approx((0.0, 0.2, -0.1, 0.1))


def test_only_where_something_is():
    values = torch.zeros(101, 51)
    values[40:43, 25] = 1.0
    field = pictures.Field("a", values, (0.0, 1.0, -0.25, 0.25), 0.1)
    (left, right), (bottom, top) = pictures._where([field])
    assert (left, right, bottom, top) == pytest.approx((0.32, 0.5, -0.08, 0.08))
    nothing = pictures.Field("b", torch.zeros(101, 51), field.bounds, 0.1)
    assert pictures._where([nothing]) == [pytest.approx((0.0, 1.0)), pytest.approx((-0.25, 0.25))]


@pytest.mark.slow
@pytest.mark.sim
def test_fields_of_the_first_view(tmp_path):
    by_particles = pictures.information_by_particles("mug-0", 1000, tmp_path)
    assert [field.title.split(",")[0] for field in by_particles] == ["P = 30", "P = 100", "P = 1000"]
    # a thousand particles are no copies of a hundred
    distinct = [int((field.title + ", 1000 distinct").split(",")[1].split()[0]) for field in by_particles]
    assert distinct[2] > 800
    planned = pictures.planned_over("mug-0", 1000, tmp_path)
    assert planned[0].title == "rumi: information"
    # the same belief, the same field
    torch.testing.assert_close(planned[0].values, by_particles[1].values)
    table = pictures.field_table(by_particles).splitlines()
    assert [float(row.split("|")[2]) > 0.9 for row in table[2:]] == [True] * 3
    (path,) = pictures.draw_fields(by_particles, tmp_path / "deep" / "fig5.png")
    assert Path(path).stat().st_size > 10_000
    assert pictures.draw_fields([], tmp_path / "none.png") == []
