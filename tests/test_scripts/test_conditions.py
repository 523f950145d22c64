"""The experiment on conditions: its variants, and the table of made-up runs."""

import pytest

from rumi.sim.conditions import GROUPS, departures
from rumi.tasks.rummage.drawn_scenes import DRAWN
from scripts import conditions as module


@pytest.mark.parametrize("name", module.CONDITIONS)
def test_a_variant_is_a_condition_with_one_group_as_in_ideal(name):
    settings = module.settings_of("mug", name, 1000)
    assert (settings.task, settings.seed) == ("mug", 1000)
    assert settings.conditions == name.partition(" ")[0].rstrip(",")
    assert settings.simulator.robot == ("arm" if name == module.ARM else "gripper")
    assert bool(departures(settings.simulator, settings.conditions)) == (name in module.WITHOUT)
    assert name not in module.WITHOUT or module.WITHOUT[name] in GROUPS


def line(conditions, seed, **changes):
    usual = {"task": "mug", "stopped_by": "sure", "right": True, "lost": False, "steps": 6, "mm": 1.0, "deg": 2.0}
    return usual | {"conditions": conditions, "seed": seed, "numbers": module.numbers()} | changes


def test_the_table_pairs_with_lab_and_leaves_out_other_numbers():
    lines = [line("lab", seed) for seed in range(3)]
    lines += [line("lab", 3, right=False, mm=9.0), line("ideal", 2, right=False, stopped_by="steps", mm=None, deg=None)]
    lines += [line("ideal", 3, steps=4), line("ideal", 4, right=False, lost=True), line("lab", 0, numbers="older")]
    ideal, lab = module.show(lines, {}).splitlines()[2:]
    assert lab.startswith("| mug | lab | 3/4 ") and "| 1/4 [" in lab and "9.0, 2.0" in lab
    assert ideal.startswith("| mug | ideal | 1/3 ") and "| 0/3 [" in ideal and "| 2 |" in ideal
    assert ideal.endswith("| 1; 1 (1) |")


def test_its_runs_are_of_the_drawn_tasks():
    kept = list(module.EXPERIMENT.variants((1000,), {}, {}))
    assert len(kept) == len(DRAWN) * len(module.CONDITIONS)
    assert all(module.EXPERIMENT.settings(one)["numbers"] == module.numbers() for one in kept)
