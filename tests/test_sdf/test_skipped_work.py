"""Accounts of what was skipped."""

import pytest
import torch

from sdf.skipped_work import Work, account, work


def do(done: float | torch.Tensor, whole: float, name: str = "points") -> None:
    with work(name) as mine:
        mine.count(done, whole)


def test_adds_up_by_name_also_in_an_account_about_it() -> None:
    with account() as outer:
        do(1, 4)
        with account() as inner:
            do(2, 4)
            do(0, 5, "sums")
        do(3, 4)
    assert inner.skipped() == {"points": 0.5, "sums": 1.0}
    assert outer.skipped() == {"points": 0.5, "sums": 1.0}
    assert (outer.works["points"].done, outer.works["points"].whole) == (6, 12)
    assert outer.works["points"].seconds > inner.works["points"].seconds > 0


def test_without_an_account_nothing_is_kept() -> None:
    do(1, 4)
    with account() as kept:
        pass
    do(1, 4)
    assert kept.works == {}


def test_an_error_keeps_what_was_counted_before() -> None:
    with account() as outer:
        with pytest.raises(RuntimeError, match="broken"), account():
            do(1, 4)
            raise RuntimeError("broken")
        do(1, 4)
    assert outer.skipped() == {"points": 0.75}
    assert outer.works["points"].whole == 8


def test_saved_time_is_that_of_the_rest_at_the_same_pace() -> None:
    assert Work(1, 4, 2.0).saved_s == pytest.approx(6.0)
    assert Work(4, 4, 2.0).saved_s == 0.0
    assert Work(0, 4, 0.0).saved_s is None
    assert Work().skipped == 0.0


def test_no_time_is_kept_of_work_unlike_the_rest() -> None:
    with account() as kept, work("sums", alike=False) as mine:
        mine.count(1, 100)
    assert kept.works["sums"].seconds == 0.0
    assert kept.skipped() == {"sums": 0.99}


def test_what_a_gpu_counts_is_pending_until_it_is_fetched(monkeypatch) -> None:
    monkeypatch.setattr("sdf.skipped_work.may_look", lambda number: False)
    with account() as kept:
        do(torch.tensor(1), 4)
        do(torch.tensor(2.0), 4)
        do(torch.tensor(3), 8, "sums")
        do(1, 2)
    assert [float(number) for number in kept.pending()] == [1.0, 2.0, 3.0]
    kept.settle([1.0, 2.0, 3.0])
    assert kept.pending() == []
    assert kept.skipped() == {"points": 0.6, "sums": 0.625}
