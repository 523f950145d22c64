import pytest

from rumi.cli import main
from rumi.commands import view as command
from rumi.runs.folder import RunRecorder
from rumi.viz.viewer import CURVES
from tests.fixtures.made_up_run import make_up

pytest.importorskip("rerun")


@pytest.fixture
def folder(tmp_path):
    made = make_up(5, particles=10)
    with RunRecorder(tmp_path / "run", {"task": "mug-0", "seed": 3}, made.geometry) as recorder:
        for step in made.steps:
            recorder(step)
    return tmp_path / "run"


def test_a_recording_holds_scene_curves_and_reasons(folder, monkeypatch, capsys):
    opened = []
    monkeypatch.setattr(command.subprocess, "Popen", lambda words, **more: opened.append(words))
    monkeypatch.setattr(command, "has_display", lambda: True)
    assert main(["view", str(folder), "--headless"]) == 0 and not opened
    assert main(["view", str(folder)]) == 0
    path = folder / "run.rrd"
    assert opened[0][-1] == str(path) and str(path) in capsys.readouterr().out
    data = path.read_bytes()
    assert data[:4] in (b"RRF2", b"RRIO", b"RRF3") and len(data) > 10_000
    for entity in ("world/particles", "world/object", "world/points/free", "world/contacts", "world/plan/path", "why"):
        assert entity.encode() in data, entity
    for curve in CURVES:
        assert f"curves/{curve}".encode() in data, curve
    assert {one.name for one in folder.iterdir()} >= {"run.rrd"} and not list(folder.glob(".*"))


def test_a_log_is_no_run(tmp_path, capsys):
    log = tmp_path / "log.h5"
    log.touch()
    assert main(["view", str(log)]) == 2
    assert "`rumi replay" in capsys.readouterr().err
