"""Readings of what RUMI leaves open: the preset is one of them, and what is printed another."""

import pytest
import torch

from rumi.tasks.rummage.scenes import find_task
from rumi.tasks.rummage.settings import preset
from scripts.paper_readings import READINGS, half_as_far, parts_of, possible, settings_of


def test_the_preset_is_a_reading():
    assert settings_of("rounds, mm") == preset("paper")


def test_as_printed_all_is_in_metres_and_after_ten_steps():
    printed = settings_of("as printed")
    assert (printed.filter.peakiness, printed.filter.trigger) == (2.0, 5.0)
    assert (printed.filter.descent.iterations, printed.filter.descent.rounds) == (10, 1)


@pytest.mark.parametrize("reading", READINGS)
def test_readings_differ(reading):
    def decided(one):
        return settings_of(one), "camera" in parts_of(one)

    assert [other for other in READINGS if decided(other) == decided(reading)] == [reading]


def test_the_rate_goes_as_far_as_the_noise_in_the_steps_printed():
    follows = settings_of("rate").filter
    assert follows.descent.learning_rate * follows.descent.iterations == pytest.approx(follows.translation_noise_m)


def test_a_camera_half_as_far_looks_along_the_same_line():
    spec = find_task("mug-0")
    near = half_as_far(spec)
    mug = torch.tensor((*spec.start[:2], spec.camera.target[2]))
    far, own = (torch.tensor(one.camera.position) - mug for one in (spec, near))
    torch.testing.assert_close(own, far / 2.0)


def test_what_is_about_a_view_needs_a_camera():
    readings = [one for one in READINGS if not possible({"task": "drill-0", "reading": one})]
    assert all("near" in one or "camera" in one for one in readings) and len(readings) == 8
    assert all(possible({"task": "mug-0", "reading": one}) for one in READINGS)
