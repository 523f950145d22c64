import pytest

from rumi.bench.timing import SHORTEST_S, Timing, time_in_turn


def test_quartiles():
    timing = Timing((5.0, 1.0, 2.0, 4.0, 3.0))
    assert timing.median_s == 3.0
    assert timing.quartiles_s == (2.0, 4.0)
    assert Timing((7.0,)).quartiles_s == (7.0, 7.0)
    assert timing.scaled(10.0).quartiles_s == (20.0, 40.0)
    assert timing.least_s == 1.0
    assert timing.scatters and not Timing((1.0, 1.1, 1.2)).scatters


def test_each_call_has_its_turn_in_every_round(clock):
    order = []

    def call(name, seconds):
        def run():
            order.append(name)
            clock.now += seconds

        return run

    calls = {name: call(name, seconds) for name, seconds in (("a", 0.1), ("b", 0.2), ("c", 0.3))}
    timings = time_in_turn(calls, budget_s=2.5, clock=clock)
    assert {name: timing.median_s for name, timing in timings.items()} == pytest.approx({"a": 0.1, "b": 0.2, "c": 0.3})
    # twice to warm up, then the rounds that the budget allows, each begun by another one
    assert "".join(order) == "aabbcc" + "abc" + "bca" + "cab" + "abc"
    assert {len(timing.samples_s) for timing in timings.values()} == {4}


def test_quick_calls_are_repeated_within_a_sample(clock):
    count = 0

    def quick():
        nonlocal count
        count += 1
        clock.now += SHORTEST_S / 10

    timing = time_in_turn({"it": quick}, budget_s=0.0, least=2, clock=clock)["it"]
    assert timing.median_s == pytest.approx(SHORTEST_S / 10)
    assert count == 2 + 2 * 10
    assert len(time_in_turn({"it": quick}, budget_s=1e9, most=5, clock=clock)["it"].samples_s) == 5


def test_the_collector_runs_again_afterwards(clock):
    import gc

    def fails():
        clock.now += 1.0
        if not gc.isenabled():
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        time_in_turn({"it": fails}, budget_s=1.0, clock=clock)
    assert gc.isenabled()


def test_what_is_not_warmed_is_called_once_a_round(clock):
    calls = []
    timings = time_in_turn(
        {name: lambda name=name: calls.append(name) for name in ("first", "second")},
        budget_s=100.0,
        least=1,
        clock=clock,
        warm=False,
    )
    assert calls == ["first", "second"]
    assert [len(timing.samples_s) for timing in timings.values()] == [1, 1]
