"""Readings of what RUMI leaves open: the preset is one of them, and what is printed another."""

import pytest

from rumi.tasks.rummage.settings import preset
from scripts.paper_readings import READINGS, settings_of


def test_the_preset_is_a_reading():
    assert settings_of("rounds, mm") == preset("paper")


def test_as_printed_all_is_in_metres_and_after_ten_steps():
    printed = settings_of("as printed")
    assert (printed.filter.peakiness, printed.filter.trigger) == (2.0, 5.0)
    assert (printed.filter.descent.iterations, printed.filter.descent.rounds) == (10, 1)


@pytest.mark.parametrize("reading", READINGS)
def test_readings_differ(reading):
    assert [other for other in READINGS if settings_of(other) == settings_of(reading)] == [reading]
