"""The scripts that vary the touch-box task and time it."""

import importlib.util
import sys
from pathlib import Path

import pytest

pytest.importorskip("mujoco")

from rumi.runs.jsonlines import read_lines
from rumi.tasks.grasp_table import clearance_table
from rumi.tasks.touch_box.gripper_robot import GripperRobot


@pytest.fixture(autouse=True)
def quick(monkeypatch, tmp_path):
    """The grasps' table is simulated elsewhere."""
    monkeypatch.setattr("rumi.tasks.touch_box.grasps.grasp_table", lambda *a, **k: clearance_table(0.03, 0.08, 0.08))
    monkeypatch.setenv("RUMI_CACHE", str(tmp_path))


def load(name):
    path = Path(__file__).resolve().parents[2] / "scripts" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def test_variants_are_run_once_and_held_against_the_first(tmp_path, monkeypatch, capsys):
    script, results = load("touch_ablations"), tmp_path / "ablations.jsonl"
    names = ["quasi-static truth", "quasi-static truth, no noise"]
    asked = ["touch_ablations.py", "run", "--variants", *names, "--seeds", "2001", "--results", str(results)]
    monkeypatch.setattr(sys, "argv", asked)
    for _ in range(2):
        script.main()
    lines = [line for line, _ in read_lines(results)]
    assert [line["settings"]["variant"] for line in lines] == names
    said = capsys.readouterr().out
    for line in lines:
        lifted, actions = line["figures"]["lifted"], line["figures"]["actions"]
        assert f"| {line['settings']['variant']} | {int(lifted)}/1 = " in said
        assert f"] | {actions:.1f} (" in said
    assert "| quasi-static truth against | actions, paired |" in said


def test_runs_of_older_code_are_not_counted_beside_the_same_of_newer(tmp_path, monkeypatch, capsys):
    script, results = load("touch_ablations"), tmp_path / "ablations.jsonl"
    steps = [{"readings": "01", "seconds": {"plan": 0.1}}]
    for code, seed, lifted, actions in (("old", 2001, False, 9), ("old", 2002, True, 5), ("new", 2001, True, 3)):
        asked = {"part": "touch-ablation", "variant": "default", "seed": seed, "code": code}
        figures = {"lifted": lifted, "sure": True, "actions": actions, "believed": 0.95, "steps": steps}
        script.Ledger(results).measure(asked | {"settings": script.VARIANTS["default"].digest}, lambda f=figures: f)
    shown = ["touch_ablations.py", "show", "--variants", "default", "--seeds", "2000-2009", "--results", str(results)]
    monkeypatch.setattr(sys, "argv", shown)
    script.main()
    said = capsys.readouterr().out
    assert "| default | 2/2 = 1.00" in said and "| 4.0 (1.4) |" in said


def test_variants_differ_in_what_they_change():
    script = load("touch_ablations")
    digests = [variant.digest for variant in script.VARIANTS.values()]
    assert len(set(digests)) == len(digests)
    soft = script.VARIANTS["soft contact in the truth"].parts().agent
    assert isinstance(soft.robot, GripperRobot)
    assert soft.robot.physics.contact_s == 0.02
    assert script.VARIANTS["default"].parts().agent.robot.physics.contact_s == 0.002
    for name, variant in script.VARIANTS.items():
        assert variant.slow == (variant.settings.push_model == "mujoco"), name


def test_unknown_variants_are_refused(monkeypatch):
    script = load("touch_ablations")
    monkeypatch.setattr(sys, "argv", ["touch_ablations.py", "show", "--variants", "no nonsense"])
    with pytest.raises(SystemExit, match="no nonsense"):
        script.main()


def test_decisions_are_timed(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["touch_times.py", "--rounds", "1", "--methods", "max-contact"])
    load("touch_times").main()
    row = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("| max-contact |"))
    assert float(row.split("|")[2].split("(")[0]) > 0
