"""What the command line lists, and how its flags become settings."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from rumi import __version__, exit_codes
from rumi.cli import COMMANDS, main
from rumi.commands.run import parse
from rumi.tasks.registry import TASKS
from rumi.tasks.rummage.drawn_scenes import DRAWN
from rumi.tasks.rummage.scenes import SCENES
from rumi.tasks.rummage.settings import preset

pytestmark = pytest.mark.usefixtures("at_home")
ROOT = Path(__file__).resolve().parent.parent.parent


def test_tasks_are_listed():
    # in a process of its own: experiments that other tests load bring tasks
    code = "from rumi.cli import main; main(['tasks']); print('----'); main(['run', '--help'])"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    listed, helped = said.split("----\n")
    names = [text.split()[0] for text in listed.splitlines()]
    assert names == [*SCENES, *DRAWN, "touch-box", "peg", "handle"]
    assert helped.endswith(listed)


def test_help_loads_nothing_and_names_every_command():
    code = "import sys; from rumi.cli import main; main(['--help']); assert not {'torch', 'tyro'} & set(sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert all(f"  rumi {name}" in done.stdout for name in COMMANDS)


@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "run"])
def test_every_command_has_help(name, capsys):
    assert main([name, "--help"]) == exit_codes.DONE
    said = capsys.readouterr()
    assert f"rumi {name}" in said.out and said.err == ""


@pytest.mark.parametrize("name", ["mug-0", "touch-box", "peg", "handle"])
def test_every_task_lists_its_settings(name, capsys):
    assert main(["run", name, "--help"]) == exit_codes.DONE
    said = " ".join(capsys.readouterr().out.split())
    for flag in (f"usage: rumi run {name}", "--preset", "--seed", "--out", "--record", "--no-figures"):
        assert flag in said
    if name == "mug-0":  # numbers that learning code may give as tensors are numbers here
        assert "--filter.peakiness FLOAT" in said and "--filter.translation-noise-m FLOAT" in said


def test_version(capsys):
    assert main(["--version"]) == exit_codes.DONE
    assert capsys.readouterr().out == f"rumi {__version__}\n"
    assert main([]) == exit_codes.BAD_INPUT


def settings_of(*arguments):
    return parse(arguments)[2].settings


def test_flags_reach_the_settings():
    asked = ["--preset", "paper", "--filter.motion", "sticking", "--filter.trigger", "7", "--filter.peakiness", "3"]
    name, _, options = parse(["mug-1", *asked])
    expected = preset("paper", task="mug-1")
    following = replace(expected.filter, motion="sticking", trigger=7.0, peakiness=3.0)
    assert options.settings == replace(expected, filter=following)
    assert (name, options.figures, options.preset) == ("mug-1", True, "paper")
    # both spellings, and switches
    settings = settings_of("mug-0", "--filter.free_scale=5", "--planner.mppi.no-include-nominal")
    assert settings.filter.free_scale == 5.0
    assert not settings.planner.mppi.include_nominal
    assert settings_of("mug-0") == preset()
    assert settings_of("mug-0", "--plan-budget-s", "0.05") == preset(plan_budget_s=0.05)
    peg = settings_of(
        "peg", "--preset=paper", "--action-budget-s", "20", "--evaluation-s", "None", "--table-m", "1", "2"
    )
    assert (peg.settings.stop, peg.settings.action_budget_s, peg.settings.evaluation_s) == ("contacts", 20.0, None)
    assert peg.settings.table_m == (1.0, 2.0)
    handle = settings_of("handle", "--sensors", "wrench,camera", "--run-budget-s", "30", "--wrist.outlier", "0.2")
    assert (handle.settings.sensors, handle.settings.run_budget_s) == (("camera", "wrench"), 30.0)
    assert (handle.settings.preset, handle.settings.wrist.outlier) == ("fast", 0.2)
    touch = settings_of("touch-box", "--plan-budget-s", "0.1", "--task.rates", "0.9", "0.05", "--filter.sweeps", "1")
    assert (touch.plan_budget_s, touch.task.rates, touch.settings.filter.sweeps) == (0.1, (0.9, 0.05), 1)


def test_a_former_name_of_a_task_is_told_and_taken(capsys):
    assert settings_of("fused", "--sensors", "camera") == settings_of("handle", "--sensors", "camera")
    assert "the task fused is now handle" in capsys.readouterr().err


def test_labels_are_folders():
    assert [
        TASKS[name].label(settings_of(name, "--seed", "2")) for name in ("mug-0", "touch-box", "peg", "handle")
    ] == [*("mug-0-rumi-default-s2", "touch-box-sequence-gripper-s2", "peg-t10-mass-s2", "handle-all-s2")]
