"""The setting `conditions`: what it stands for, what is said of it, and what is refused beside it."""

from dataclasses import replace

import pytest

from rumi import exit_codes
from rumi import preset as rumi_preset
from rumi.cli import main
from rumi.commands.run import parse
from rumi.sim.conditions import put_back, under
from rumi.tasks.registry import TASKS
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.drawn_scenes import DRAWN
from rumi.tasks.rummage.scenes import SCENES
from rumi.tasks.rummage.settings import DRAWN_CONDITIONS, Settings, from_dict, preset, to_dict

pytestmark = pytest.mark.usefixtures("at_home")


def settings_of(*arguments):
    return parse(arguments)[2].settings


def test_conditions_are_what_the_simulators_settings_start_from():
    lab = settings_of("mug-0", "--conditions", "lab")
    assert lab == preset(conditions="lab") == rumi_preset(task="mug-0", conditions="lab")
    assert lab == replace(preset(), conditions="lab", simulator=under(preset().simulator, "lab"))
    # what is asked for itself wins, before and after
    for flags in (
        ("--conditions=lab", "--simulator.measures-motion"),
        ("--simulator.measures-motion", "--conditions=lab"),
    ):
        found = settings_of("mug-0", *flags, "--simulator.pads.dead", "0.3")
        pads = replace(lab.simulator.pads, dead=0.3)
        assert found == replace(lab, simulator=replace(lab.simulator, measures_motion=True, pads=pads))
    noisy = rumi_preset(**{"simulator.pads.dead": 0.3}, task="mug-0", conditions="harsh")
    assert noisy.simulator == replace(under(preset().simulator, "harsh"), pads=noisy.simulator.pads)
    assert noisy.simulator.pads.dead == 0.3 and noisy.simulator.pads.missed > 0
    paper = settings_of("mug-0", "--preset", "paper", "--conditions", "harsh")
    assert paper.simulator == under(preset("paper").simulator, "harsh") and paper.simulator.free_fraction == 0.95
    assert settings_of("mug", "--conditions", "ideal").simulator == preset().simulator
    back = put_back(put_back(lab.simulator, "images"), "bubbles")
    assert (back.sensors.lost, back.sensors.bubble_noise_m, back.view) == (0.0, 0.0, lab.simulator.view)


def test_tasks_that_draw_their_scene_have_conditions_of_their_own():
    assert {settings_of(name).conditions for name in DRAWN} == {DRAWN_CONDITIONS}
    assert {settings_of(name).conditions for name in SCENES} == {Settings().conditions} == {"ideal"}
    for name in ("mug", "drill"):
        assert settings_of(name) == preset(task=name) == rumi_preset(task=name)
        assert settings_of(name).simulator == under(Settings().simulator, DRAWN_CONDITIONS)


def test_conditions_are_said_and_kept():
    settings = settings_of("mug", "--conditions", "lab", "--seed", "2")
    assert TASKS["mug"].label(settings) == "mug-rumi-default-lab-s2"
    assert from_dict(to_dict(settings)) == settings and to_dict(settings)["conditions"] == "lab"
    assert TASKS["mug"].role("conditions") == "sensed"


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["mug-0", "--conditions", "outdoors"], "no conditions 'outdoors'; there are ideal, lab, harsh"),
        (["drill", "--simulator.view.holes", "0.1"], "a task with a camera with --simulator.view.holes 0.1"),
        (["drill", "--simulator.sensors.calibration-m", "0.1"], "a task with a camera with --simulator.sensors.cal"),
        (["mug-0", "--simulator.sensors.kind", "both", "--simulator.pads.dead", "0.1"], "kind points with"),
        (["mug-0", "--conditions", "lab", "--simulator.sensors.lost", "0.5"], "kind camera, bubbles or both"),
        (["shelf-mug", "--simulator.sensors.motion-noise-m", "0.1"], "a slip sensor"),
    ],
)
def test_conditions_that_make_no_sense_are_refused(flags, words, capsys):
    assert main(["run", *flags]) == exit_codes.BAD_INPUT
    assert words in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("task", ["drill", "drawn-shelf-mug", "mug-0"])
@pytest.mark.parametrize("conditions", ["lab", "harsh"])
def test_what_a_task_has_no_use_for_of_its_conditions_is_idle(task, conditions):
    settings = settings_of(task, "--conditions", conditions)
    TASKS[task].check(settings)
    if task == "mug-0":
        TASKS[task].check(replace_sensors(settings, kind="both"))


def replace_sensors(settings, **changes):
    sensors = replace(settings.simulator.sensors, **changes)
    return replace(settings, simulator=replace(settings.simulator, sensors=sensors))


@pytest.mark.sim
def test_a_simulated_run_relies_on_its_conditions(all_in_reach):
    found = settings_of("mug-0", "--conditions", "lab", "--simulator.measures-motion")
    with build(found, cache_dir=all_in_reach) as parts:
        assert parts.agent.relies_on.endswith("conditions: lab, but measures_motion True")
