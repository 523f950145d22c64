"""A wrist force sensor in the rummaging tasks: readings gain a force and nothing else; who takes none in is refused."""

from dataclasses import replace

import pytest
import torch

from rumi.errors import UsageError
from rumi.sim.sensor_settings import SensorSettings
from rumi.sim.settings import SimSettings
from rumi.tasks.rummage.build import make_task
from rumi.tasks.rummage.motions import check_pushing
from rumi.tasks.rummage.scenes import find_task
from rumi.tasks.rummage.settings import Settings, preset
from sensors.reading import FORCE


@pytest.mark.sim
def test_a_wrist_adds_its_force_and_changes_nothing_else(arm_tool, mug):
    spec = replace(find_task("mug-0"), start=(0.40, 0.0, 0.3))
    found = []
    for wrist in (False, True):
        settings = SimSettings(measures_motion=False, sensors=SensorSettings(wrist_force=wrist))
        task = make_task(spec, settings, tool=arm_tool, model=mug)
        task.reset(0)
        found.append([task.step(torch.tensor([1.0, 0.0, 0.1])) for _ in range(3)][-1])
    without, felt = (own.reading for own in found)
    assert torch.equal(found[0].truth, found[1].truth)
    assert torch.equal(without.observation.points, felt.observation.points)
    assert without.measurements == {} and felt.measurements[FORCE].shape == (20, 3)
    assert bool(felt.in_contact.any())
    assert float(felt.measurements[FORCE][felt.in_contact, 0].mean()) < -0.5  # it resists


def wristed(task: str, motion: str) -> Settings:
    settings = preset("default", task=task, conditions="ideal")
    sensors = replace(settings.simulator.sensors, wrist_force=True)
    return replace(
        settings,
        simulator=replace(settings.simulator, sensors=sensors),
        filter=replace(settings.filter, motion=motion),
    )


def test_a_force_that_nothing_takes_in_is_refused():
    check_pushing(find_task("mug"), wristed("mug", "trajectory"))
    for task, motion in (("mug", "measured"), ("mug", "corrected"), ("drill", "trajectory")):
        with pytest.raises(UsageError, match="nothing else takes in a force"):
            check_pushing(find_task(task), wristed(task, motion))
