"""Each size in a process of its own, which is ended when it takes too long or too much memory."""

import pytest

from scripts.bench import scaling_study as scaling
from scripts.bench import scaling_work
from scripts.bench.ledger import Ledger
from scripts.bench.scaling_figure import draw
from scripts.bench.scaling_study import measure_apart
from scripts.bench.scaling_work import SIZES, WORK, Size

pytestmark = pytest.mark.usefixtures("at_home")


@pytest.mark.parametrize("name", WORK)
def test_every_work_runs_along_its_axes(name):
    make, axes = WORK[name]
    small = Size(particles=5, points=400, samples=4, horizon=3)
    for axis in axes:
        grown = {"particles": 7, "points": 900, "samples": 6, "horizon": 5, "scenes": 2}[axis]
        make(Size(**(vars(small) | {axis: grown})))()
        assert len(SIZES[axis]) >= 2


def test_time_and_memory_of_a_call_are_measured():
    figures = measure_apart("posed_query", Size(particles=2000))
    assert figures["ended"] == "done"
    # 2000 poses by 2300 points, a distance and a gradient of four bytes a number
    assert figures["result_bytes"] == 2000 * 2300 * 4 * 4
    assert figures["peak_bytes"] >= figures["result_bytes"]
    assert figures["seconds"] > 0


def test_too_much_memory_ends_it():
    figures = measure_apart("posed_query", Size(particles=50_000), memory_bytes=2**29)
    assert figures == {"ended": "memory"}


def test_too_much_time_ends_it():
    assert measure_apart("posed_query", Size(particles=20_000), call_s=0.01) == {"ended": "time"}


def test_a_series_ends_where_a_size_does_not_end_well(tmp_path, monkeypatch):
    asked = []

    def instead(name, size):
        asked.append(size.particles)
        if size.particles > 100:
            return {"ended": "memory"}
        return {"ended": "done", "seconds": 1.0, "processor_s": 1.0, "peak_bytes": 2e6, "result_bytes": 10}

    monkeypatch.setattr(scaling, "measure_apart", instead)
    monkeypatch.setattr(scaling, "WORK", {"posed_query": scaling_work.WORK["posed_query"]})
    ledger = Ledger(tmp_path / "a.jsonl")
    assert list(scaling.measure(ledger, quick=False)) == [True, True, True]
    assert asked == [10, 100, 1000]
    assert list(scaling.measure(ledger, quick=False)) == [False, False, False]
    (path,) = draw(ledger, tmp_path)
    assert path.stat().st_size > 1000
