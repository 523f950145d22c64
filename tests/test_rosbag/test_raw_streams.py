"""What a simulated robot's sensors gave is kept with the run, and read again it is what the run took in."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rumi.cli import main
from rumi.errors import UsageError
from rumi.rosbag.mapping_file import mapping_of
from rumi.rosbag.readings import make_readings
from rumi.runs.logbook import LogRecorder
from sdf import se3
from sensors.log.reader import Log
from sensors.log.writer import LogWriter
from sensors.semantics import Semantics

pytest.importorskip("mujoco")
pytest.importorskip("h5py")
pytest.importorskip("cv2")
pytestmark = pytest.mark.sim


def pushed(sensors, path, lost=0):
    """Readings of three pushes, the mug's poses after each, and the mapping of what was recorded of them.

    The camera's first pictures are lost, as many as told.
    """
    from rumi.sim.settings import SimSettings
    from rumi.tasks.rummage.build import make_task
    from rumi.tasks.rummage.scenes import SCENES, large_handled_mug, make_tool

    mug = large_handled_mug()
    spec = replace(SCENES["mug-0"], start=(0.45, 0.03, 0.6))
    task = make_task(spec, SimSettings(sensors=sensors), tool=make_tool(spec, free_flying=True), model=mug)
    if lost:
        late = iter([True] * lost + [False] * 10_000)
        task._lost = lambda: next(late)
    with LogRecorder(path, raw=task.raw.kinds()) as log:
        task.raw.sink = log.raw
        results = [task.reset(3)]
        results += [task.step(torch.tensor(control)) for control in ([1.0, 0.3, 0.0], [1.0, 0.1, 0.0], [0.9, 0.0, 0.0])]
    return [one.reading for one in results], [one.truth for one in results], mapping_of(task.raw.mapping()), mug


@pytest.mark.parametrize("degraded", [False, True])
def test_bubbles_read_again_feel_the_same(degraded, tmp_path):
    from rumi.sim.conditions import image_errors
    from rumi.sim.sensor_settings import SensorSettings

    sensors = image_errors("bubbles") if degraded else SensorSettings("bubbles")
    live, _, mapping, _ = pushed(sensors, tmp_path / "log.h5")
    with Log(tmp_path / "log.h5") as log:
        made = make_readings(log, mapping)
    assert made.problems == [] and len(made.taken) == 4
    for ours, theirs in zip(made.taken[1:], live[1:], strict=True):
        reading = ours.reading
        torch.testing.assert_close(reading.tool_pose, theirs.tool_pose, atol=1e-6, rtol=0)
        assert torch.equal(reading.in_contact, theirs.in_contact)
        mine, them = (one.observation.of_class(Semantics.SURFACE) for one in (reading, theirs))
        assert torch.equal(reading.instant[mine].bincount(), theirs.instant[them].bincount())
        for k in theirs.instant[them].unique().tolist():
            points = [one.observation.points[of & (one.instant == k)] for one, of in ((reading, mine), (theirs, them))]
            # one bubble after the other in the log, by turns live
            ordered = [each[each[:, 1].argsort(stable=True)] for each in points]
            torch.testing.assert_close(*ordered, atol=1e-5, rtol=0)
    assert int(live[-1].in_contact.sum()) > 3


def test_a_first_look_that_lasted_longer_is_read_as_long(tmp_path):
    from rumi.sim.sensor_settings import SensorSettings

    live, _, mapping, _ = pushed(SensorSettings("both"), tmp_path / "log.h5", lost=9)
    with Log(tmp_path / "log.h5") as log:
        made = make_readings(log, mapping)
    assert made.problems == [] and len(made.taken) == 4
    for ours, theirs in zip(made.taken, live, strict=True):
        torch.testing.assert_close(ours.reading.tool_pose[-1], theirs.tool_pose[-1], atol=1e-6, rtol=0)
        seen = [one.observation.of_class(Semantics.SURFACE) for one in (ours.reading, theirs)]
        assert min(int(each.sum()) for each in seen) > 300
    assert bool((made.taken[-1].reading.in_contact[:20] == live[-1].in_contact).all())


def test_views_read_again_leave_the_gripper_out(tmp_path):
    from rumi.sim.sensor_settings import SensorSettings

    live, truth, mapping, mug = pushed(SensorSettings("both"), tmp_path / "log.h5")
    seen = {}
    with Log(tmp_path / "log.h5") as log:
        assert log.stream("camera/depth").samples()[0].values["depth"].shape == (240, 320)
        for known in (True, False):
            # free space is not looked at here: a small box about mug and gripper is enough
            within = ((0.20, -0.15, 0.0), (0.70, 0.15, 0.1))
            told = replace(mapping, scene=replace(mapping.scene, tool_seen=known, within=within))
            seen[known] = make_readings(log, told).taken
    last = [taken[-1].reading for taken in (seen[True], seen[False])]
    off = []
    for reading in last:
        surface = reading.observation.of_class(Semantics.SURFACE) & (reading.instant == len(reading.tool_pose) - 1)
        points = se3.apply(se3.inverse(truth[-1]), reading.observation.points[surface])
        off.append(float(mug.exact.distance(points).abs().max()))
    assert off[0] < 0.003 and off[1] > 0.05
    first, theirs = (one.observation for one in (seen[True][0].reading, live[0]))
    surface, them = (one.points[one.of_class(Semantics.SURFACE)] for one in (first, theirs))
    # from the seventh picture on all have lasted: the live view is the last one's, this one the first's
    torch.testing.assert_close(surface, them, atol=1e-5, rtol=0)


@pytest.mark.slow
def test_a_recorded_run_can_be_read_by_its_map(tmp_path, monkeypatch, capsys):
    pytest.importorskip("pytorch_kinematics")
    monkeypatch.chdir(tmp_path)
    few = ["--initialise.particles", "12", "--initialise.starts", "24", "--initialise.polished", "12"]
    asked = ["run", "mug-0", "--simulator.sensors.kind", "bubbles", "--record", "--steps", "1", "--no-figures"]
    main([*asked, "--out", "one", *few, "--planner.mppi.samples", "20", "--planner.rollouts", "2"])
    (tmp_path / "few.toml").write_text(
        (tmp_path / "one/map.toml").read_text()
        + "[settings]\ninitialise = { particles = 12, starts = 24, polished = 12 }\n"
    )
    capsys.readouterr()
    main(["replay", "one", "--map", "few.toml"])
    said = capsys.readouterr()
    assert "bubble left/depth: 0 of 21 pictures show a touch" in said.err
    assert "no live run's to compare with" in said.out


def test_the_map_of_a_run_with_a_mesh_names_the_mesh(tmp_path, monkeypatch):
    from rumi.sim.sensor_settings import SensorSettings
    from rumi.sim.settings import SimSettings
    from rumi.tasks.rummage.build import make_task
    from rumi.tasks.rummage.objects import ObjectSettings
    from rumi.tasks.rummage.scenes import SCENES, large_handled_mug, make_tool

    monkeypatch.chdir(tmp_path)
    spec = replace(SCENES["mug-0"], start=(0.45, 0.03, 0.6))
    settings = SimSettings(sensors=SensorSettings("bubbles"))
    task = make_task(spec, settings, tool=make_tool(spec, free_flying=True), model=large_handled_mug())
    task.reset(0)
    assert mapping_of(task.raw.mapping()).scene.builtin == "mug"
    thing = ObjectSettings(mesh='a "box".stl', scale=0.001, upright=(0.0, 90.0, 0.0), mass_kg=0.4)
    told = mapping_of(task.raw.mapping(thing))
    assert told.scene.builtin is None
    assert told.object == replace(thing, mesh=str(tmp_path / 'a "box".stl'))


def test_only_what_has_raw_streams_may_be_read_by_a_map(tmp_path):
    from rumi.commands.replay import mapping_of_log

    with LogWriter(tmp_path / "log.h5", [], settings={}):
        pass
    with Log(tmp_path / "log.h5") as log:
        assert mapping_of_log(log, None) is None
        with pytest.raises(UsageError, match="no raw streams"):
            mapping_of_log(log, Path("some.toml"))
