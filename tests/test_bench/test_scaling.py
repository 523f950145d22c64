"""Each size in a process of its own, which is ended when it takes too long or too much memory."""

import pytest

from scripts.bench.scaling_study import measure_apart
from scripts.bench.scaling_work import Size

pytestmark = pytest.mark.usefixtures("at_home")


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
