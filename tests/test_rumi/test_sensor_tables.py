"""The scripts that measure the converters and close the loop through them: resumable, and right in what they count."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

pytest.importorskip("cv2")

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"


def load(name):
    spec = importlib.util.spec_from_file_location(name, SCRIPTS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def test_errors_are_measured_once_and_shown(tmp_path, capsys, monkeypatch):
    table = load("vision_table")
    monkeypatch.setattr(table, "WAYS", {name: table.WAYS[name] for name in ("bubble",)})
    monkeypatch.setattr(table, "NOISES_MM", (0.0, 1.0))
    out = tmp_path / "vision.jsonl"
    for _ in range(2):
        table.errors(table.Errors(seeds=2, out=out))
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    assert [(x["scene"], x["noise_mm"]) for x in lines] == [
        (scene, noise) for scene in ("plane", "sphere", "box") for noise in (0.0, 1.0)
    ]
    quiet, noisy = lines[0], lines[1]
    assert quiet["mean_mm"] < 0.05 < noisy["mean_mm"] < 0.5 and quiet["inside"] == noisy["inside"] == 0
    table.show(table.Show(out=out))
    rows = capsys.readouterr().out.splitlines()[2:]
    assert len(rows) == 2 and rows[1].startswith("| bubble | 1 | ")
    monkeypatch.setattr(table, "fingerprint", lambda: "other code")
    table.show(table.Show(out=out))
    assert len(capsys.readouterr().out.splitlines()) == 2


def test_runs_are_carried_out_once_and_wrong_stops_counted(tmp_path, capsys, monkeypatch):
    pytest.importorskip("mujoco")
    table = load("sensor_table")
    made = []

    def carry_out(name, task, seed, cache):
        made.append((name, task, seed))
        wrong = seed == 1001
        return {
            "sensors": name, "settings": table.stamp(name), "task": task, "seed": seed, "right": not wrong, "steps": 7,
            "stopped_by": "converged" if seed < 1002 else "steps", "position_error_mm": 9.0 if wrong else 1.0,
            "rotation_error_deg": 2.0,
        }  # fmt: skip

    monkeypatch.setattr(table, "carry_out", carry_out)
    out = tmp_path / "sensors.jsonl"
    options = table.Run(seeds="1000-1002", tasks=("mug-0",), sensors=("camera", "both, degraded"), out=out)
    table.run(options)
    table.run(options)
    assert made == [(name, "mug-0", seed) for seed in (1000, 1001, 1002) for name in ("camera", "both, degraded")]
    table.show(table.Show(out=out))
    rows = capsys.readouterr().out.splitlines()
    assert rows[2].startswith("| camera | 2/3 [") and "| 1 | 1 | 1 | 7 | 1.0, 2.0 | 9.0, 2 |" in rows[2]
    assert rows[-1] == "| both, degraded, mug-0, seed 1001 | sure | 9.0, 2.0 | - | - | - |"
    # of those that were not right each is repeated once with each part left out, and kept out of the first table
    made.clear()
    table.why(table.Why(out=out))
    table.why(table.Why(out=out))
    assert made == [(f"both, degraded, {part}", "mug-0", 1001) for part in table.PARTS]
    table.show(table.Show(out=out))
    after = capsys.readouterr().out.splitlines()
    assert after[:-1] == rows[:-1]
    assert after[-1].count("not right, 9.0, 2.0") == len(table.PARTS)


@pytest.mark.slow
@pytest.mark.sim
def test_a_run_through_images_is_a_line(tmp_path):
    pytest.importorskip("mujoco")
    pytest.importorskip("pytorch_kinematics")
    table = load("sensor_table")
    line = table.carry_out("both, degraded", "mug-0", 1000, tmp_path)
    assert json.loads(json.dumps(line)) == line
    assert line["stopped_by"] in ("sure", "steps") and isinstance(line["right"], bool)
