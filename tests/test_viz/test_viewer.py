import os
import signal
import subprocess
import sys
from dataclasses import replace

import pytest
import torch

from rumi.cli import main
from rumi.commands import recordings
from rumi.commands import view as command
from rumi.runs.folder import RunRecorder
from rumi.viz import live
from rumi.viz.rummaging_view import PLOTS, RummagingView
from sensors.contact_reading import ContactReading, WrenchTouch
from sensors.reading import FORCE
from tests.fixtures.made_up_run import make_up

rerun = pytest.importorskip("rerun")


SHOWN = (
    *("world/particles", "world/object", "world/points/free", "world/points/surface", "world/out_of_reach"),
    *("world/tool/outline", "world/contacts", "world/wrench/force", "world/wrench/touches"),
    *("world/plan/path", "world/plan/samples", "world/plan/information", "why"),
)


def with_wrenches(made):
    """The run, of a robot with a wrist that feels forces and a touch by them, and told of faults."""

    def felt(step):
        reading = step.reading
        force = torch.full((len(reading.tool_pose), 3), 2.0)
        force[0] = torch.nan  # at rest nobody knows it yet
        contact = ContactReading.of(replace(reading, measurements={FORCE: force}))
        at, one = reading.tool_pose[-1:, :3, 3], torch.ones(1)
        touch = WrenchTouch(at, torch.eye(3)[:1], 0.001 * one, 0.1 * one, torch.zeros(1, dtype=torch.long))
        told = {"no fault": 0.9, "dead hand": 0.1}
        return replace(step, reading=replace(contact, wrench=touch), explanations=told)

    return replace(made, steps=[felt(step) for step in made.steps])


@pytest.fixture
def folder(tmp_path):
    made = with_wrenches(make_up(5, particles=10))
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
    for entity in SHOWN:
        assert entity.encode() in data, entity
    for curve in PLOTS:
        assert f"curves/{curve}".encode() in data, curve
    assert {one.name for one in folder.iterdir()} >= {"run.rrd"} and not list(folder.glob(".*"))


def test_a_file_that_is_no_log_is_refused(tmp_path, capsys):
    log = tmp_path / "log.h5"
    log.touch()
    assert main(["view", str(log)]) == 2
    assert "log.h5" in capsys.readouterr().err


def test_a_fresh_recording_is_not_written_again(folder, monkeypatch):
    assert main(["view", str(folder), "--headless"]) == 0
    monkeypatch.setattr(command, "write", lambda *_: pytest.fail("written again"))
    assert main(["view", str(folder), "--headless"]) == 0
    later = (folder / "run.rrd").stat().st_mtime + 1
    os.utime(folder / "trace.npz", (later, later))  # the run went on
    assert not command.is_fresh(folder / "run.rrd", folder)


def test_the_recording_of_a_log_is_fresh_as_long_as_the_log_is_older(folder, tmp_path):
    log, path = tmp_path / "pushes.h5", tmp_path / "pushes.rrd"
    log.write_bytes(b"log")
    command.write(folder, path)
    assert command.is_fresh(path, log)
    later = path.stat().st_mtime + 1
    os.utime(log, (later, later))
    assert not command.is_fresh(path, log)


def test_a_run_keeps_its_recording_where_the_viewer_is_installed(folder, monkeypatch, capsys):
    recordings.keep(folder)
    assert command.is_fresh(folder / "run.rrd", folder)
    (folder / "run.rrd").unlink()
    monkeypatch.setattr(recordings.importlib.util, "find_spec", lambda name: None)
    recordings.keep(folder)
    assert not (folder / "run.rrd").exists()


def test_a_run_that_cannot_be_shown_ends_as_it_would(folder, monkeypatch, capsys):
    (folder / "trace.npz").write_bytes(b"")
    recordings.keep(folder)
    assert "no recording" in capsys.readouterr().err and not (folder / "run.rrd").exists()


class Process:
    """A viewer that listens to nobody."""

    def __init__(self, words, *, stubborn=False, gone=False):
        self.words, self.ended, self.pid = words, False, -7
        self.stubborn, self.gone, self.waited = stubborn, gone, 0

    def end(self, pid, number):
        if self.gone:
            raise PermissionError
        self.ended = pid == self.pid and (number == signal.SIGKILL or not self.stubborn)

    def wait(self, timeout):
        self.waited += 1
        if not (self.ended or self.gone):
            raise subprocess.TimeoutExpired("viewer", timeout)


@pytest.mark.parametrize("display", [False, True])
def test_a_live_view_shows_what_a_recording_holds(display, tmp_path, monkeypatch, capsys):
    made, opened = with_wrenches(make_up(5, particles=10)), []
    monkeypatch.setattr(live, "has_display", lambda: display)
    monkeypatch.setattr(live.subprocess, "Popen", lambda *words, **more: opened.append(Process(*words)) or opened[0])
    monkeypatch.setattr(live.os, "killpg", lambda *given: opened[0].end(*given))
    stream = rerun.RecordingStream
    to_file = lambda self, url, default_blueprint: stream.save(self, tmp_path / "run.rrd", default_blueprint)  # noqa: E731
    monkeypatch.setattr(stream, "connect_grpc", to_file)
    with live.LiveView("run", RummagingView(made.geometry), lambda steps: steps[-1].belief.summary()) as view:
        for step in made.steps:
            view(step)
    data = (tmp_path / "run.rrd").read_bytes()
    for entity in (*SHOWN, *(f"curves/{name}" for name in PLOTS)):
        assert entity.encode() in data, entity
    words = opened[0].words
    assert words[words.index("--bind") + 1] == "127.0.0.1"
    assert ("--serve-web" in words, opened[0].ended, "http://127.0.0.1:" in capsys.readouterr().err) == (
        not display,
    ) * 3


@pytest.fixture
def served(monkeypatch):
    """A live view without a display, of the viewer process that it is given."""
    monkeypatch.setattr(live, "has_display", lambda: False)

    def view(process):
        monkeypatch.setattr(live.subprocess, "Popen", lambda *words, **more: process)
        monkeypatch.setattr(live.os, "killpg", process.end)
        return live.LiveView("run", RummagingView(None), lambda steps: None)

    return view


@pytest.mark.parametrize(("kind", "waited"), [({"stubborn": True}, 2), ({"gone": True}, 1)])
def test_a_viewer_that_will_not_end_or_is_gone_does_the_run_no_harm(kind, waited, served, monkeypatch):
    process = Process([], **kind)
    monkeypatch.setattr(rerun.RecordingStream, "connect_grpc", lambda *given, **more: None)
    with served(process):
        pass
    assert process.waited == waited and (process.ended or process.gone)


def test_a_view_that_cannot_begin_leaves_no_viewer_behind(served, monkeypatch):
    def no_connection(*given, **more):
        raise RuntimeError("no connection")

    process = Process([])
    monkeypatch.setattr(rerun.RecordingStream, "connect_grpc", no_connection)
    with pytest.raises(RuntimeError, match="no connection"), served(process):
        pass
    assert process.ended and process.waited == 1


def test_a_run_without_the_viewer_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["run", "mug-0", "--view", "--no-figures", "--out", str(tmp_path / "run")]) == 2
    assert "[view]" in capsys.readouterr().err and not (tmp_path / "run").exists()
