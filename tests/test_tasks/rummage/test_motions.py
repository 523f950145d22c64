"""What follows the object where nothing measures its motion."""

from dataclasses import replace

import pytest

from rumi.errors import UsageError
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.drawn_scenes import DRAWN
from rumi.tasks.rummage.motions import check_trajectory, followed, guarded
from rumi.tasks.rummage.scenes import SCENES, find_task
from rumi.tasks.rummage.settings import Settings, preset


def without_sensor(task: str, name: str = "default") -> Settings:
    settings = preset(name, task=task)
    return replace(settings, simulator=replace(settings.simulator, measures_motion=False))


@pytest.mark.parametrize("task", [*SCENES, *DRAWN])
def test_what_is_measured_is_evidence_of_what_may_topple_and_taken_as_it_is_elsewhere(task):
    spec, settings = find_task(task), preset(task=task, conditions="ideal")
    apart = not spec.measures_motion or (spec.spatial and spec.prior is not None)
    assert followed(spec, settings).motion == ("trajectory" if apart else "measured")
    assert guarded(spec, settings).guarded == ("always" if apart else "never")
    asked = replace(settings, filter=replace(settings.filter, motion="measured"))
    assert followed(spec, asked).motion == ("measured" if spec.measures_motion else "trajectory")
    printed = followed(spec, preset("paper", task=task, conditions="ideal"))
    assert printed.motion == ("measured" if spec.measures_motion else "estimated")


def test_a_measured_motion_that_no_trajectory_takes_in_is_taken_as_it_is():
    settings = preset(task="drill", conditions="ideal", **{"filter.free_points": "dropped"})
    assert followed(find_task("drill"), settings).motion == "measured"


@pytest.mark.parametrize(
    ("task", "motion"),
    [
        ("mug-0", "trajectory"),
        ("mug", "trajectory"),
        ("shelf-mug", "trajectory"),  # a camera that looks again is evidence of it, no other motion
        ("drill", "trajectory"),
        ("drawn-shelf-box", "trajectory"),
    ],
)
def test_without_a_slip_sensor_the_motion_that_suits_takes_its_place(task, motion):
    settings = without_sensor(task)
    assert followed(find_task(task), settings).motion == motion
    asked = replace(settings, filter=replace(settings.filter, unmeasured="sticking"))
    assert followed(find_task(task), asked).motion == "sticking"
    assert followed(find_task(task), without_sensor(task, "paper")).motion == "estimated"


def test_what_no_trajectory_takes_in_is_corrected():
    settings = without_sensor("mug")
    sensed = replace(settings.simulator, sensors=replace(settings.simulator.sensors, kind="bubbles"))
    assert followed(find_task("mug"), replace(settings, simulator=sensed)).motion == "corrected"
    dropped = replace(settings, filter=replace(settings.filter, free_points="dropped"))
    assert followed(find_task("mug"), dropped).motion == "corrected"
    with pytest.raises(UsageError, match="free-points ride"):
        check_trajectory(dropped)


def test_where_plans_are_made_changes_nothing_of_the_belief():
    settings = replace(without_sensor("mug"), device="cuda")
    assert followed(find_task("mug"), settings).motion == "trajectory"


@pytest.mark.sim
def test_a_simulator_without_the_sensor_is_followed_without_it(all_in_reach):
    with build(without_sensor("mug-0"), cache_dir=all_in_reach) as (task, agent):
        assert agent.filter.settings.motion == "trajectory"
        assert task.reset(0).reading.object_motion is None
