"""The script that holds whole runs by push model against each other."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

from rumi.runs.jsonlines import append_line, read_lines

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def script() -> ModuleType:
    path = Path(__file__).resolve().parents[2] / "scripts" / "push_runs.py"
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def test_runs_are_done_once(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    results = tmp_path / "runs.jsonl"
    arguments = ["push_runs.py", "run", "--tasks", "mug-0", "--models", "quasi-static, few", "--seeds", "1000"]
    monkeypatch.setattr(sys, "argv", [*arguments, "--results", str(results)])
    for _ in range(2):
        script.main()
    lines = [line for line, _ in read_lines(results)]
    assert len(lines) == 1
    figures = lines[0]["figures"]
    assert 0 < figures["steps"] <= 40
    assert figures["cpu_s"] > 0
    row = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("| quasi-static, few"))
    assert f"| {int(figures['right'])}/1 [" in row
    assert f"| {figures['steps']} |" in row


def test_tables_are_over_all_runs_and_over_those_that_all_have_done(script: ModuleType, tmp_path: Path) -> None:
    results = tmp_path / "runs.jsonl"
    for model, seed, right, steps in (
        ("displacement", 1000, True, 10),
        ("displacement", 1001, False, 20),
        ("mujoco", 1000, True, 8),
    ):
        asked = {"part": script.PART, "model": model, "task": "drill-0", "seed": seed, "code": "x"}
        figures = {"right": right, "stopped_by": "sure", "steps": steps, "cpu_s": 4.0, "wall_s": 9.0}
        append_line(results, {"settings": asked, "figures": figures})
    whole, alike = script.show(script.Options("show", results=results)).split("\n\n| push")[1:]
    assert "| displacement | 1/2 [0.09, 0.91] | 15 | 1/2 | 4.0 | 0.27 |" in whole
    assert "| displacement | 1/1 [0.21, 1.00] | 10 | 1/1 | 4.0 | 0.40 |" in alike
    assert "| mujoco | 1/1 [0.21, 1.00] | 8 | 1/1 | 4.0 | 0.50 |" in alike


def test_what_a_model_cannot_push_is_left_out(script: ModuleType) -> None:
    assert script.settings_of("quasi-static", "drill-0", 0) is None
    engine = script.settings_of("mujoco", "drill-0", 0).planner
    assert engine.engine.mass_kg == 0.9
    few = script.settings_of("displacement, few", "drill-0", 0).planner
    assert (engine.mppi, engine.rollouts) == (few.mppi, few.rollouts)
