"""Selection against a deadline, on a clock that is told how long things take."""

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch

from rumi.clock import SimulatedClock
from rumi.planning import anytime
from rumi.planning.anytime import Candidate, Selection, in_descending_posterior, select
from rumi.planning.duration_model import DurationModel

ONE = DurationModel.known(1.0)


def choose(
    pairs: list[tuple[float, float]],
    t_max_s: float,
    *,
    evaluation: DurationModel = ONE,
    takes: Callable[[], float] = lambda: 1.0,
    making_s: float = 0.0,
    **options,
) -> tuple[Selection[int], SimulatedClock]:
    """Candidates by (execution time, gain)."""
    clock = SimulatedClock(100.0)

    def gain(index: int) -> float:
        clock.advance(takes())
        return pairs[index][1]

    def candidates() -> Iterator[Candidate[int]]:
        for index, (execution, _) in enumerate(pairs):
            clock.advance(making_s)
            yield Candidate(index, execution)

    made = select(candidates(), gain, t_max_s, evaluation=evaluation, now=clock, **options)
    assert made.thinking_s == pytest.approx(clock() - 100.0)
    return made, clock


def test_takes_the_best_that_fits() -> None:
    made, _ = choose([(2.0, 0.1), (9.5, 5.0), (4.0, 0.3), (3.0, 0.2)], 10.0)
    assert made.candidate.action == 2
    assert (made.generated, made.evaluated, made.skipped, made.doublings) == (4, 3, 1, 0)
    assert made.thinking_s == 3.0
    assert made.late_s == pytest.approx(-3.0)
    assert made.ended == "exhausted"
    assert [event.taken for event in made.history] == [True, True, False]
    assert made.measured == ((1.0, 1.0),) * 3


def test_the_printed_deadline_is_missed_and_ours_is_kept() -> None:
    """The best takes 8 s of 10; evaluating a short loser for 2 s more would end at 11.9 s."""
    pairs = [(8.0, 1.0), (0.5, 0.1), (0.5, 0.1)]
    made, _ = choose(pairs, 10.0, evaluation=DurationModel.known(1.9), takes=lambda: 1.9)
    assert made.candidate.action == 0
    assert made.evaluated == 1
    assert made.thinking_s + made.candidate.execution_s == pytest.approx(9.9)
    # the test as printed lets the loser in
    assert 0.5 + 1.9 < 10.0 - 1.9 < 8.0 + 1.9


def test_equal_gains_keep_the_likelier_candidate() -> None:
    made, _ = choose([(1.0, 0.0), (2.0, 0.5), (1.0, 0.5)], 10.0)
    assert made.candidate.action == 1


def test_no_candidate_is_made_that_could_not_be_evaluated() -> None:
    """With 0.9 s left and evaluations of 1 s, thinking is over."""
    made, _ = choose([(2.0, 1.0)] * 100, 3.9, making_s=0.001)
    assert (made.generated, made.evaluated, made.ended) == (1, 1, "deadline")
    assert made.late_s == pytest.approx(-0.899)


def test_nothing_to_gain_is_to_stay() -> None:
    """Candidates end: no doubling would bring any more."""
    made, _ = choose([(1.0, 0.0), (2.0, 0.0)], 10.0)
    assert made.candidate is None
    assert (made.gain, made.doublings, made.ended) == (0.0, 0, "exhausted")


def test_too_little_time_is_doubled() -> None:
    made, _ = choose([(9.0, 1.0), (20.0, 2.0)], 3.0)
    assert made.candidate.action == 0
    # 3 and 6 s were too few for 9 s of motion and 1 s of thinking; nothing was made twice
    assert (made.doublings, made.t_max_s, made.generated, made.evaluated, made.skipped) == (2, 12.0, 2, 1, 1)
    assert made.late_s <= 0


@pytest.mark.parametrize("kept", [1, 10, 1_000])
def test_of_more_than_can_wait_the_quickest_are_kept(kept: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The only one that doubled time is enough for comes last, in the middle, or first."""
    monkeypatch.setattr(anytime, "_KEPT", kept)
    count = 2 * kept + 5
    for place in (0, count // 2, count - 1):
        pairs = [(50.0, 9.0)] * count
        pairs[place] = (5.0, 3.0)
        made, _ = choose(pairs, 3.0)
        assert (made.candidate.action, made.gain, made.doublings) == (place, 3.0, 1)
        assert (made.generated, made.evaluated, made.skipped) == (count, 1, count - 1)


def test_those_that_wait_are_tried_in_the_order_in_which_they_came(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(anytime, "_KEPT", 3)
    pairs = [(8.0, 0.1), (60.0, 9.0), (6.0, 0.2), (70.0, 9.0), (9.0, 0.3), (80.0, 9.0), (90.0, 9.0)]
    made, _ = choose(pairs, 7.0)
    assert [event.execution_s for event in made.history] == [6.0]
    made, _ = choose(pairs, 5.0, doublings=1)
    assert [event.execution_s for event in made.history] == [8.0, 6.0]


def test_doublings_are_capped() -> None:
    made, _ = choose([(1e6, 1.0)], 3.0, doublings=2)
    assert made.candidate is None
    assert (made.doublings, made.t_max_s, made.evaluated) == (2, 12.0, 0)
    none, _ = choose([(1e6, 1.0)], 3.0, doublings=0)
    assert (none.candidate, none.doublings, none.t_max_s) == (None, 0, 3.0)


def test_waits_for_candidates_that_come_slowly() -> None:
    """Staying still, time runs out in the making; the first that comes in the doubled time is taken."""
    made, _ = choose([(100.0, 1.0)] * 5 + [(1.0, 1.0)], 4.0, making_s=1.0)
    assert made.candidate.action == 5
    assert made.doublings == 1


def test_making_candidates_counts() -> None:
    making = DurationModel.known(1.0)
    free, _ = choose([(2.0, 0.1), (2.0, 0.2), (2.0, 0.3), (2.0, 0.4)], 6.0)
    paid, _ = choose([(2.0, 0.1), (2.0, 0.2), (2.0, 0.3), (2.0, 0.4)], 6.0, making_s=1.0, generation=making)
    assert (free.candidate.action, paid.candidate.action) == (3, 1)
    assert free.late_s <= 0
    assert paid.late_s <= 0
    # not knowing that making takes time, it starts on one more
    unaware, _ = choose([(2.0, 0.1), (2.0, 0.2), (2.0, 0.3)], 5.6, making_s=1.5)
    assert unaware.late_s == pytest.approx(0.4)


def test_candidates_of_different_work() -> None:
    clock = SimulatedClock()
    model = DurationModel(0.5, 0.1)

    def gain(work: float) -> float:
        clock.advance(model.mean(work))
        return work

    candidates = [Candidate(work, 1.0, work) for work in (1.0, 100.0, 20.0)]
    made = select(candidates, gain, 5.0, evaluation=model, now=clock)
    assert made.candidate is candidates[2]
    assert made.skipped == 1
    assert made.measured == ((1.0, pytest.approx(0.6)), (20.0, pytest.approx(2.5)))


def test_no_time_at_all() -> None:
    made, _ = choose([(1.0, 1.0)], 0.0)
    assert made.candidate is None
    assert made.thinking_s == 0.0
    nothing, _ = choose([], 5.0)
    assert (nothing.candidate, nothing.generated, nothing.ended) == (None, 0, "exhausted")


@pytest.mark.parametrize("seed", range(3))
def test_never_late_where_times_are_known(seed: int) -> None:
    """Any candidates, any budgets: with exact times no decision ends late."""
    random = np.random.default_rng(seed)
    for _ in range(300):
        pairs = list(zip(random.lognormal(1.0, 1.0, 30).tolist(), random.exponential(1.0, 30).tolist(), strict=True))
        step = float(random.choice([0.01, 0.3, 1.0]))
        made, _ = choose(
            pairs,
            float(10 ** random.uniform(-1.7, 1.3)),
            evaluation=DurationModel.known(step),
            takes=lambda step=step: step,
            making_s=0.005,
            generation=DurationModel.known(0.005),
        )
        assert made.late_s <= 1e-9
        assert made.skipped + made.evaluated == made.generated
        gains = [event.gain for event in made.history]
        assert made.gain == max(gains, default=0.0)


@pytest.mark.parametrize("level", [0.9, 0.99])
def test_noisy_times_are_late_as_seldom_as_was_said(level: float) -> None:
    random = np.random.default_rng(7)
    evaluation = DurationModel.fit(np.ones(2000), random.lognormal(-1.0, 0.5, 2000), level)
    late, count = 0, 600
    for _ in range(count):
        pairs = list(zip(random.uniform(0.5, 8.0, 60).tolist(), random.exponential(1.0, 60).tolist(), strict=True))
        made, _ = choose(pairs, 8.0, evaluation=evaluation, takes=lambda: float(random.lognormal(-1.0, 0.5)))
        late += made.late_s > 0
    assert late / count <= 1 - level + 3 * math.sqrt(level * (1 - level) / count)
    # and thinking does go on to the end
    assert late > 0 or level > 0.9


def test_more_time_finds_no_less() -> None:
    random = np.random.default_rng(2)
    pairs = list(zip(random.uniform(0.5, 8.0, 40).tolist(), random.exponential(1.0, 40).tolist(), strict=True))
    found = [choose(pairs, budget)[0].gain for budget in (2.0, 4.0, 8.0, 16.0, 48.0)]
    assert found == sorted(found)
    assert found[-1] == max(gain for _, gain in pairs)


def test_likelier_particles_come_first_and_lazily() -> None:
    asked = []

    def of_particle(index: int) -> list[Candidate[tuple[int, int]]]:
        asked.append(index)
        return [Candidate((index, k), 1.0) for k in range(2)]

    log_weights = torch.tensor([0.1, 0.4, 0.4, 0.0, 0.1]).log()
    source = in_descending_posterior(log_weights, of_particle)
    assert [next(source).action for _ in range(3)] == [(1, 0), (1, 1), (2, 0)]
    assert asked == [1, 2]
    assert [candidate.action[0] for candidate in source] == [2, 0, 0, 4, 4]


def test_refuses_what_has_no_meaning() -> None:
    with pytest.raises(ValueError, match="t_max_s"):
        choose([], -1.0)
    with pytest.raises(ValueError, match="t_max_s"):
        choose([], math.nan)
    with pytest.raises(ValueError, match="doublings"):
        choose([], 1.0, doublings=-1)
    with pytest.raises(ValueError, match="number, got nan"):
        choose([(1.0, math.nan)], 10.0)
    with pytest.raises(ValueError, match="seconds"):
        SimulatedClock().advance(-1.0)
