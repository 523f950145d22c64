"""Labels of knocks in recorded runs, by runs made up, and the record's figures on a short simulated one."""

import os

import numpy as np
import pytest

from scripts import knocks
from scripts.bench.real_knocks import HALF_M, TIP_M, Run, corners, faultless, gap_m, runs
from scripts.bench.real_knocks import knocks as labels


def run(seconds: float = 3.0) -> Run:
    """A square pushed straight at 50 mm/s, 1 kHz."""
    time = np.arange(0.0, seconds, 1e-3)
    pose, tip = np.zeros((len(time), 3)), np.zeros((len(time), 2))
    pose[:, 0] = 0.05 * time
    tip[:, 0] = pose[:, 0] - HALF_M - TIP_M
    return Run("made up", time, pose, tip)


def test_a_tip_that_touches_has_no_gap_however_the_square_turns() -> None:
    own = run(0.01)
    np.testing.assert_allclose(gap_m(own), 0.0, atol=1e-12)
    apart = own._replace(tip=own.tip - np.array([2e-3, 0.0]))
    np.testing.assert_allclose(gap_m(apart), 2e-3, atol=1e-12)
    turned = own._replace(pose=own.pose + np.array([0.0, 0.0, np.pi / 2]))
    np.testing.assert_allclose(gap_m(turned), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.hypot(*corners(own.pose)[0].T), np.sqrt(2.0) * HALF_M)


def test_pushing_alone_is_no_knock_and_a_hand_is() -> None:
    own = run()
    assert labels(own) == []
    hit = own.pose.copy()
    hit[:, 1] += 0.02 * np.clip((own.time - 1.5) / 0.05, 0.0, 1.0)
    (found,) = labels(own._replace(pose=hit))
    assert found.begin == pytest.approx(1.51, abs=0.02)
    assert 1.55 <= found.end <= 1.7
    times = np.arange(0.0, 3.0, 0.02)
    good = faultless(own._replace(pose=hit), times)
    assert not good[(times > 1.5) & (times < 2.0)].any()
    assert good[(times < 1.4) | (times > 2.3)][:-5].all()


def test_a_tracker_that_is_late_and_catches_up_is_no_knock_and_not_faultless() -> None:
    own = run()
    late = own.pose.copy()
    held = (own.time > 1.0) & (own.time < 1.3)
    late[held] = late[1000]
    own = own._replace(pose=late)
    assert labels(own) == []
    times = np.arange(0.0, 3.0, 0.02)
    assert not faultless(own, times)[(times > 1.06) & (times < 1.3)].any()


@pytest.mark.data
@pytest.mark.skipif("RUMI_DATA" not in os.environ, reason="needs recorded data")
def test_runs_without_knocks_by_name_have_none_and_knocked_ones_have_some() -> None:
    found = {name: len(labels(own)) for name, own in runs().items()}
    assert sum(found.values()) == 7
    assert not any(count for name, count in found.items() if "NoPert" in name or "OpenLoop" in name)


def test_a_simulated_run_is_the_same_by_its_seed_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(knocks, "SECONDS", 5.0)
    first, again = (knocks.simulated(1, knocked=True) for _ in range(2))
    assert first.pose.equal(again.pose)
    assert len(first.knocks) == 1
    figures = knocks.counted(first, 1)
    assert figures["good_s"] + figures["other_s"] == pytest.approx(5.0)
    assert len(figures["delays"]) == len(figures["covers_again_s"]) == 1
    line = {"readings": "knocked", **figures}
    assert "knocked" in knocks.show([line], {})
