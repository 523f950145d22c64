"""Bounds of evaluation times: kept as often as they say, whatever the distribution."""

import numpy as np
import pytest

from rumi.planning.duration_model import DurationModel


def test_known_is_exact() -> None:
    known = DurationModel.known(1.5)
    assert known.bound(3.0) == known.mean(0.0) == 1.5


def test_finds_a_line() -> None:
    work = [1.0, 2.0, 4.0, 8.0] * 50
    found = DurationModel.fit(work, [0.01 + 0.002 * size for size in work], level=0.9)
    assert found.fixed_s == pytest.approx(0.01)
    assert found.per_work_s == pytest.approx(0.002)
    assert found.margin == pytest.approx(1.0)
    assert found.count == 200


def test_neither_part_is_negative() -> None:
    falling = DurationModel.fit([1.0, 2.0, 3.0], [3.0, 2.0, 1.0])
    assert (falling.fixed_s, falling.per_work_s) == (2.0, 0.0)
    steep = DurationModel.fit([1.0, 2.0, 3.0], [0.0, 2.0, 4.0])
    assert steep.fixed_s == 0.0
    assert steep.per_work_s > 0
    assert DurationModel.fit([0.0], [0.0]).bound() == 0.0


NOISES = {
    "lognormal": lambda random, count: random.lognormal(0.0, 0.5, count),
    "exponential": lambda random, count: random.exponential(1.0, count),
    "heavy": lambda random, count: random.pareto(2.5, count) + 0.1,
    "rare stalls": lambda random, count: np.where(random.random(count) < 0.02, 20.0, 1.0),
}


@pytest.mark.parametrize("name", NOISES)
@pytest.mark.parametrize("level", [0.9, 0.99])
def test_is_kept_as_often_as_it_says(name: str, level: float) -> None:
    """Single evaluations, and rows of them that go on while the bound leaves time."""
    random = np.random.default_rng(0)
    draw = NOISES[name]
    single, late = [], []
    for _ in range(40):
        bound = DurationModel.fit(np.ones(500), draw(random, 500), level).bound()
        single.append(float((draw(random, 2000) > bound).mean()))
        first = 20.0 * random.uniform(1.0, 2.0, (40, 1)) * bound
        left = first - draw(random, 40 * 4000).reshape(40, 4000).cumsum(1)
        # the first time at which the bound leaves no more time
        end = np.argmax(left < bound, axis=1)
        assert bool((left[:, -1] < bound).all())
        late.append(float((left[np.arange(40), end] < 0).mean()))
    # three standard errors of the mean over fits
    assert np.mean(single) <= 1 - level + 3 * np.std(single) / np.sqrt(40)
    assert np.mean(late) <= 1 - level + 3 * max(np.std(late), np.sqrt((1 - level) / 40)) / np.sqrt(40)


def test_a_heavy_tail_asks_for_more_than_the_quantile() -> None:
    times = np.where(np.arange(1000) < 5, 300.0, 1.0)
    found = DurationModel.fit(np.ones(1000), times, level=0.95)
    # the quantile is 1 s, and yet most of the time is spent in the few that take 300 s
    assert found.bound() > 200.0


def test_no_work_takes_the_time_that_it_took() -> None:
    """A line by least squares that falls below 0 at no work, where four in ten measurements are."""
    work, seconds = [0.0, 0.0, 1.0, 2.0, 3.0] * 40, [0.01, 0.01, 0.5, 1.2, 2.0] * 40
    for level in (0.9, 0.99):
        found = DurationModel.fit(work, seconds, level)
        assert 0.01 <= found.bound(0.0) <= 0.02
        longer = sum(took > found.bound(size) for size, took in zip(work, seconds, strict=True))
        assert longer <= (1 - level) * len(work)
        assert found.bound(3.0) < 4.0
    # nothing at no work, and a line through it
    assert DurationModel.fit([0.0, 1.0, 2.0], [0.0, 1.0, 2.0]).bound(0.0) == 0.0


@pytest.mark.parametrize("name", NOISES)
def test_rows_of_different_work_are_in_time_as_often_as_it_says(name: str) -> None:
    """Work of nothing and up to ten, times with an error that grows with work: the last one spans what is left."""
    random, level = np.random.default_rng(1), 0.9
    single, spans = [], []
    for _ in range(40):
        work = random.choice([0.0, 0.1, 1.0, 10.0], 500)
        found = DurationModel.fit(work, (0.01 + work) * NOISES[name](random, 500), level)
        fresh = random.choice([0.0, 0.1, 1.0, 10.0], 4000)
        took = (0.01 + fresh) * NOISES[name](random, 4000)
        bound = found.margin * (found.fixed_s + found.per_work_s * fresh)
        single.append(float((took > bound).mean()))
        spans.append(float(np.maximum(took - bound, 0.0).sum() / took.sum()))
    assert np.mean(single) <= 1 - level + 3 * np.std(single) / np.sqrt(40)
    assert np.mean(spans) <= 1 - level + 3 * np.std(spans) / np.sqrt(40)


def test_few_measurements_have_a_wide_bound() -> None:
    assert DurationModel.fit([1.0, 1.0], [1.0, 3.0], level=0.99).bound() == pytest.approx(6.0)


@pytest.mark.parametrize(
    ("work", "seconds", "level", "said"),
    [
        ([], [], 0.9, "at least one"),
        ([1.0], [1.0, 2.0], 0.9, "as many seconds"),
        ([1.0], [-1.0], 0.9, "0 or more"),
        ([1.0], [float("nan")], 0.9, "finite"),
        ([1.0], [1.0], 1.0, "level"),
    ],
)
def test_refuses_what_are_no_measurements(work, seconds, level, said) -> None:
    with pytest.raises(ValueError, match=said):
        DurationModel.fit(work, seconds, level)
    with pytest.raises(ValueError, match="fixed_s"):
        DurationModel(-1.0)
