"""Each experiment: its table over the results on record, and a variant measured where that is quick."""

import importlib
import math
from pathlib import Path

import pytest
import torch

from rumi.cli import main
from scripts.experiment import RESULTS
from sdf.mesh.triangles import Triangles
from sdf.surface import sample_triangles

SHOWN = Path(__file__).resolve().parents[1] / "fixtures" / "tables"
"""What `show` prints of the results on record; after a change of those: python -m scripts.NAME show > NAME.md."""

REPRODUCED = {
    "mugs": ("table5", "table6", "--tasks", "mug-0", "mug-1", "mug-2"),
    "peg": ("allocation-table1", "allocation-accuracy", "allocation-time", "--seeds", "0-99"),
    # run with the default of then
    "touch": ("touch-table1", "--settings.filter.lever-m", str(1.22 * 0.0447), str(2.45 * 0.0447)),
}

PAGES = SHOWN.parents[2] / "scripts" / "docs" / "results"
HELD = {
    "conditions": "conditions",
    "localize_table": "localize",
    "long_pushes": "push_models",
    "plan_regrets": "choosing",
    "sensor_table": "cameras",
    "slack_curve": "slack",
    "torque_rates": "forces",
}
"""Pages that hold a table of these as it is."""


def experiment(name):
    module = pytest.importorskip(f"scripts.{name}", exc_type=ImportError)
    return module, module.EXPERIMENT


@pytest.mark.parametrize("path", sorted(SHOWN.glob("*.md")), ids=lambda path: path.stem)
def test_the_tables_of_what_is_on_record(path, capsys, at_home):
    if path.stem in REPRODUCED:
        figures = () if path.stem == "touch" else ("--no-figures",)
        results = str(RESULTS / f"{path.stem}.jsonl")
        assert main(["reproduce", *REPRODUCED[path.stem], "--show", "--results", results, *figures]) == 0
        assert capsys.readouterr().out == path.read_text()
    else:
        _, made = experiment(path.stem)
        assert made.show(RESULTS / made.results) == path.read_text()


@pytest.mark.parametrize("name", HELD)
def test_pages_hold_the_tables_of_what_is_on_record(name):
    assert (SHOWN / f"{name}.md").read_text().strip() in (PAGES / f"{HELD[name]}.md").read_text()


@pytest.fixture
def wedge(tmp_path, monkeypatch):
    """Touches of a wedge, in the place of the recorded ones."""
    folder = tmp_path / "icub_touch"
    folder.mkdir()
    corners = torch.tensor([[0.0, 0.0, 0.0], [0.15, 0.0, 0.0], [0.02, 0.1, 0.0], [0.03, 0.02, 0.07]]).double()
    faces = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]
    rows = ["OFF", "4 4 0", *(" ".join(map(str, x)) for x in corners.tolist())]
    (folder / "wedge.off").write_text("\n".join([*rows, *("3 " + " ".join(map(str, f)) for f in faces)]) + "\n")
    points, _ = sample_triangles(
        Triangles(corners[torch.tensor(faces)]), 30, generator=torch.Generator().manual_seed(0)
    )
    rows = [" ".join(f"{x:.6f}" for x in row) for row in points.tolist()]
    (folder / "measWedge.off").write_text("\n".join(["OFF", "30.0 0.0 0.0", *rows]) + "\n")
    monkeypatch.setenv("RUMI_DATA", str(tmp_path))


def test_touches_are_localised(wedge, monkeypatch):
    for package in ("trimesh", "scipy"):
        pytest.importorskip(package)
    module, made = experiment("localize_table")
    monkeypatch.setitem(module.SETS, "Wedge", ("wedge.off", 0.001))
    figures = module.measure("Wedge", threads=1, seed=1000)
    assert figures["best_mm"] < 0.3 and figures["alike"] >= 1
    line = {"set": "Wedge", "seed": 1000, "threads": 1, "code": "x", **figures}
    assert "1/1 [" in made.table([line], {})


def test_without_the_data_it_says_so(monkeypatch):
    module, _ = experiment("localize_table")
    monkeypatch.delenv("RUMI_DATA", raising=False)
    with pytest.raises(SystemExit, match="RUMI_DATA"):
        module.data()


def test_errors_of_a_bubble():
    pytest.importorskip("cv2")
    module, _ = experiment("vision_table")
    quiet, noisy = (module.measure("bubble", "sphere", noise) for noise in (0.0, 1.0))
    assert quiet["mean_mm"] < 0.05 < noisy["mean_mm"] < 0.5 and quiet["inside"] == noisy["inside"] == 0
    assert (quiet["seeds"], noisy["seeds"]) == (1, module.DRAWS)


def test_wrong_stops_are_counted_and_repeated_without_parts(monkeypatch, tmp_path):
    module, made = experiment("sensor_table")
    asked = []

    def measure(sensors, task, seed):
        asked.append((sensors, task, seed))
        off = {"right": seed != 1001, "position_error_mm": 9.0 if seed == 1001 else 1.0, "rotation_error_deg": 2.0}
        return {**off, "steps": 7, "stopped_by": "converged" if seed < 1002 else "steps"}

    made = module.replace(made, measure=measure, results=str(tmp_path / "a.jsonl"))
    monkeypatch.setattr(module, "EXPERIMENT", made)
    path = tmp_path / "a.jsonl"
    made.main(
        ["run", "--seeds", "1000-1002", "--tasks", "mug-0", "--sensors", "both, degraded", "--results", str(path)]
    )
    rows = made.show(path).splitlines()
    assert "| 1 | 1 | 1 | 7 | 1.0, 2.0 | 9.0, 2 |" in rows[2]
    assert rows[-1] == "| both, degraded, mug-0, seed 1001 | sure | 9.0, 2.0 | - | - | - |"
    asked.clear()
    for _ in range(2):
        module.why(module.Why(results=path))
    assert asked == [(f"both, degraded, {part}", "mug-0", 1001) for part in module.PARTS]
    after = made.show(path).splitlines()
    assert after[:-1] == rows[:-1] and after[-1].count("not right, 9.0, 2.0") == len(module.PARTS)


def test_push_models_that_cannot_push_are_left_out_and_few_samples_are_the_engines():
    module, _ = experiment("push_runs")
    assert module.settings_of("quasi-static", "drill-0", 0) is None
    engine, few = (module.settings_of(name, "drill-0", 0).planner for name in ("mujoco", "displacement, few"))
    assert engine.engine.mass_kg == 0.9 and (engine.mppi, engine.rollouts) == (few.mppi, few.rollouts)


def test_ablations_differ_in_what_they_change(monkeypatch, tmp_path):
    pytest.importorskip("mujoco")
    from rumi.tasks.grasp_table import clearance_table

    module, _ = experiment("touch_ablations")
    grasps = importlib.import_module("rumi.tasks.touch_box.grasps")
    monkeypatch.setattr(grasps, "grasp_table", lambda *a, **k: clearance_table(0.03, 0.08, 0.08))
    monkeypatch.setenv("RUMI_CACHE", str(tmp_path))
    assert len({variant.digest for variant in module.VARIANTS.values()}) == len(module.VARIANTS)
    for name, contact_s in (("soft contact in the truth", 0.02), ("default", 0.002)):
        with module.VARIANTS[name].parts() as parts:
            assert parts.task.robot.physics.contact_s == contact_s
    figures = module.measure("quasi-static truth", 2001)
    assert figures["actions"] > 0 and math.isfinite(figures["believed"])
