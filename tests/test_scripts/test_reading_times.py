"""Recorded samples replayed: who waits for whom, and what a sample is, on a run made up."""

import numpy as np
import pytest

from scripts import reading_times
from scripts.bench.real_knocks import HALF_M, TIP_M, Run
from scripts.reading_times import measure, queued, samples_of


def run(count: int) -> Run:
    """A square pushed straight at 50 mm/s, 1 kHz, that a tracker sees at every fourth sample."""
    time = 1e-3 * np.arange(count)
    pose, tip = np.zeros((count, 3)), np.zeros((count, 2))
    pose[:, 0] = 0.05 * (time - time % 4e-3)
    tip[:, 0] = 0.05 * time - HALF_M - TIP_M
    return Run("made up", time, pose, tip)


def test_a_sample_waits_for_those_before_it() -> None:
    late = queued(np.array([0.0, 1.0, 2.0, 9.0]), np.array([0.5, 2.5, 1.0, 0.25]))
    np.testing.assert_allclose(late, [0.5, 2.5, 2.5, 0.25])


def test_a_pose_that_the_tracker_repeats_is_no_reading() -> None:
    samples = samples_of(run(40), 0)
    assert [pose is not None for pose in samples.pose[:9]] == [True, *[False] * 3, True, *[False] * 3, True]
    assert samples.pose[4] is not None
    assert float(samples.pose[4][0]) != pytest.approx(0.05 * 4e-3, abs=1e-9)  # with noise


def test_every_sample_is_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reading_times.real_knocks, "runs", lambda: {"made up": run(24)})
    found = measure("recorded", 0)
    assert (found["samples"], found["readings"]) == (23, 5)
    assert found["alone"][-1] >= found["own"][-1] > 0.0
    assert reading_times.show([found], {}).count("23 samples, 5 readings") == 3
