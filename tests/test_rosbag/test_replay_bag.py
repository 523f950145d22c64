"""A bag of a simulated run, imported and replayed: its readings are the run's, and the belief finds the object."""

from functools import cache

import pytest
import torch

from rumi.cli import main
from rumi.errors import UsageError
from rumi.exit_codes import BAD_INPUT, NOT_CONVERGED
from rumi.rosbag.bag import import_bag
from rumi.rosbag.frames import Edge, FrameTree
from rumi.rosbag.mapping_file import mapping_of
from rumi.rosbag.readings import make_readings
from rumi.rosbag.scene import rummager_of_map, settings_of
from rumi.runs.folder import load_run
from rumi.runs.replay import replay
from sdf import se3
from sensors.log.reader import Log
from sensors.log.writer import LogWriter, StreamSpec
from sensors.semantics import Semantics

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def log(recorded, bags, tmp_path_factory):
    path = tmp_path_factory.mktemp("logs") / "pushes.h5"
    done = import_bag(recorded.bag, mapping_of(bags.MAP), path)
    assert done.problems == [] and done.lost == {}
    return path


@pytest.fixture(scope="module")
def made(log, bags):
    with Log(log) as opened:
        return make_readings(opened, mapping_of(bags.MAP))


def places(taken):
    return torch.cat([one.reading.tool_pose[:, :3, 3] for one in taken])


@cache
def mug():
    from rumi.tasks.rummage.scenes import large_handled_mug

    return large_handled_mug().exact


def signed(points, pose):
    return mug().distance(se3.apply(se3.inverse(pose), points).double())


def test_the_first_view_shows_the_object_alone(made, recorded):
    assert made.problems == []
    seen = made.taken[0].reading.observation
    surface, free = (seen.points[seen.of_class(kind)] for kind in (Semantics.SURFACE, Semantics.FREE))
    assert len(surface) > 500
    distance = signed(surface, recorded.start)
    assert float(distance.abs().quantile(0.99)) < 0.002
    assert len(free) > 5000
    assert float(signed(free, recorded.start).min()) > 0


def test_readings_are_those_of_the_robot(made, recorded):
    assert len(made.taken) == len(recorded.readings)
    touched = 0
    for ours, theirs in zip(made.taken[1:], recorded.readings[1:], strict=True):
        reading = ours.reading
        torch.testing.assert_close(reading.tool_pose, theirs.tool_pose, atol=1e-5, rtol=0)
        torch.testing.assert_close(reading.configuration, theirs.configuration, atol=1e-5, rtol=0)
        assert torch.equal(reading.in_contact, theirs.in_contact)
        felt, known = (one.observation.of_class(Semantics.SURFACE) for one in (reading, theirs))
        assert int(felt.sum()) == int(known.sum())
        touched += int(felt.sum())
        expected = theirs.observation.points[known]
        # the pads move a little between the pose and the points that are sent 1 ms earlier
        torch.testing.assert_close(reading.observation.points[felt], expected, atol=5e-4, rtol=0)
        assert torch.equal(reading.instant[felt], theirs.instant[known])
    assert touched > 100
    assert made.taken[-1].reading.stamp == pytest.approx(0.2 + 1.1 * 5, abs=1e-6)


def test_what_the_tool_swept_is_free(made, recorded):
    pose, count = recorded.start, 0
    for taken, truth in zip(made.taken[1:], recorded.readings[1:], strict=True):
        observation, instant = taken.reading.observation, taken.reading.instant
        free = observation.of_class(Semantics.FREE)
        count += int(free.sum())
        for k in instant[free].unique().tolist():
            here = observation.points[free & (instant == k)]
            assert float(signed(here, truth.object_motion[k] @ pose).min()) > 0
        pose = truth.object_motion[-1] @ pose
    assert count > 1000


def test_the_replayed_belief_finds_the_object(log, bags, recorded):
    mapping = mapping_of(bags.MAP)
    with Log(log) as opened:
        taken = make_readings(opened, mapping).taken
    settings = settings_of(mapping)
    steps = []
    rummager = rummager_of_map(mapping, settings, places(taken))
    done = replay(taken, rummager, seed=0, on_step=steps.append)
    assert done.same == [None] * 6
    first, last = steps[0].belief.mode(), steps[-1].belief.mode()
    assert float((first[:2, 3] - recorded.start[:2, 3]).norm()) < 0.005
    moved = float((recorded.truth[:2, 3] - recorded.start[:2, 3]).norm())
    assert moved > 0.01
    assert float((last[:2, 3] - recorded.truth[:2, 3]).norm()) < 0.5 * moved


def test_the_command(log, tmp_path, monkeypatch, capsys, bags):
    monkeypatch.chdir(tmp_path)
    assert main(["replay", str(log), "--out", "run"]) == NOT_CONVERGED
    said = capsys.readouterr()
    assert "no live run's to compare with" in said.out
    assert "pose     x 0." in said.out
    run = load_run("run")
    assert len(run.steps) == 6
    assert run.settings["filter"]["motion"] == "sticking"
    assert main(["replay", "run"]) == NOT_CONVERGED, "what a replay wrote replays to the same beliefs"
    assert "bit for bit, after each of 6 readings" in capsys.readouterr().out
    (tmp_path / "run" / "map.toml").unlink()
    assert main(["replay", "run"]) == BAD_INPUT
    assert "replay the log again" in capsys.readouterr().err
    (tmp_path / "short.toml").write_text(bags.MAP.replace("every_s = 1.1", "every_s = 2.2"))
    main(["replay", str(log), "--map", "short.toml", "--filter.motion", "estimated", "--out", "other"])
    assert len(load_run("other").steps) < 6


def test_a_killed_replay_leaves_a_folder_that_is_read(log, tmp_path, monkeypatch):
    """The mapping is there before the first step; of a replay without one nothing is left."""
    monkeypatch.chdir(tmp_path)
    held = []

    def killed(*arguments, **options):
        held.extend(path.name for path in (tmp_path / "run").iterdir())
        raise RuntimeError("killed")

    monkeypatch.setattr("rumi.runs.replay.replay", killed)
    with pytest.raises(RuntimeError, match="killed"):
        main(["replay", str(log), "--out", "run"])
    assert "map.toml" in held
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
@pytest.mark.parametrize("organised", [False, None])
def test_other_cameras_see_the_same(organised, bags, tmp_path, recorded):
    """A cloud without order, and a depth image in millimetres."""
    depth = organised is None
    other = bags.record(tmp_path / "bag", organised=bool(organised), depth=depth)
    text = bags.MAP
    if depth:
        text = text.replace(
            '"/camera/points" = "cloud"',
            '"/camera/depth" = { role = "depth", camera = "/camera/info" }\n"/camera/info" = "camera"',
        )
    mapping = mapping_of(text)
    assert import_bag(other.bag, mapping, tmp_path / "log.h5").problems == []
    with Log(tmp_path / "log.h5") as opened:
        made = make_readings(opened, mapping)
    assert made.problems == []
    seen = made.taken[0].reading.observation
    surface = seen.points[seen.of_class(Semantics.SURFACE)]
    assert len(surface) > 500
    assert float(signed(surface, recorded.start).abs().quantile(0.99)) < 0.003


def test_what_a_recording_lacks_is_named(log, bags):
    def readings(*changes):
        text = bags.MAP
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        with Log(log) as opened:
            return make_readings(opened, mapping_of(text))

    with pytest.raises(UsageError, match=r"Nothing connects the frame 'hand' to 'base'; .* are base, camera, gripper"):
        readings(('tool = "gripper"', 'tool = "hand"'))
    with pytest.raises(UsageError, match="Nothing connects the frame 'gripper' to 'map'"):
        readings(('world = "base"', 'world = "map"'))
    with pytest.raises(UsageError, match=r"at the end of the first view, 60\.0 s"):
        readings(("view_s = 0.2", "view_s = 60.0"))


def test_a_fixed_transform_takes_the_place_of_a_recorded_one(log, bags):
    text = (
        bags.MAP
        + '\n[[fixed]]\nparent = "base"\nchild = "gripper"\nposition_m = [0.3, 0.1, 0.0]\nrpy_deg = [0, 0, 90]\n'
    )
    with Log(log) as opened:
        made = make_readings(opened, mapping_of(text))
    pose = made.taken[-1].reading.tool_pose[-1]
    torch.testing.assert_close(pose[:3, 3], torch.tensor([0.3, 0.1, 0.2]))
    torch.testing.assert_close(pose[:3, 0], torch.tensor([0.0, 1.0, 0.0]), atol=1e-6, rtol=0)


def test_an_object_is_needed(log, bags):
    mapping = mapping_of(bags.MAP.replace('builtin = "mug"\n', ""))
    with Log(log) as opened:
        taken = make_readings(opened, mapping).taken
    with pytest.raises(UsageError, match="Expected an object"):
        rummager_of_map(mapping, settings_of(mapping), places(taken))


def edge(parent, poses, stamps=()):
    return Edge(parent, torch.tensor(stamps, dtype=torch.long), torch.stack(poses).double())


def turned(x, yaw):
    return se3.from_planar(torch.tensor([x, 0.0, yaw], dtype=torch.float64))


def test_frames_are_put_together_and_interpolated():
    edges = {
        "arm": edge("base", [turned(0.0, 0.0), turned(1.0, 1.0)], [1000, 2000]),
        "hand": edge("arm", [turned(0.5, 0.2)]),
        "world": edge("base", [turned(0.0, 0.3)]),
    }
    tree = FrameTree(edges, "world", (0.0, 0.0, -0.25), 1e-6)
    pose, known = tree.at("hand", [1000, 1500, 2000, 2099, 2101, 899])
    assert known.tolist() == [True, True, True, True, False, False]
    rise = turned(0.0, 0.0)
    rise[2, 3] = 0.25
    for k, part in ((0, 0.0), (1, 0.5), (2, 1.0)):
        expected = rise @ se3.inverse(turned(0.0, 0.3)) @ turned(part, part) @ turned(0.5, 0.2)
        torch.testing.assert_close(pose[k], expected)


def test_a_frame_of_two_streams_is_told(tmp_path, bags):
    streams = [
        StreamSpec(name, "pose", about={"parent": parent, "child": "hand"})
        for name, parent in (("arm/hand", "arm"), ("base/hand", "base"))
    ]
    with LogWriter(tmp_path / "log.h5", streams) as written:
        for stream in streams:
            written.append(stream.name, 1000, 1000, pose=turned(0.0, 0.0).numpy())
    fixed = '\n[[fixed]]\nparent = "base"\nchild = "hand"\nposition_m = [0, 0, 0]\nrpy_deg = [0, 0, 0]\n'
    with Log(tmp_path / "log.h5") as opened:
        tree = FrameTree.of_log(opened, mapping_of(bags.MAP))
        assert tree.problems == ["streams arm/hand and base/hand both place the frame hand: base/hand counts"]
        assert tree.chains("hand")[0] == ["hand", "base"]
        assert FrameTree.of_log(opened, mapping_of(bags.MAP + fixed)).problems == []


def test_gaps_in_frames_are_not_bridged():
    edges = {"hand": edge("base", [turned(0.0, 0.0)] * 3, [0, 1000, 9000])}
    tree = FrameTree(edges, "base", longest_gap_s=2e-6)
    _, known = tree.at("hand", [500, 1100, 5000, 8900])
    assert known.tolist() == [True, True, False, True]


def test_a_world_far_away_is_brought_near_in_double_precision():
    x, y = 412_345.678, 5_812_345.25
    far = turned(x, 0.0)
    far[1, 3] = y
    edges = {"base": edge("map", [far]), "hand": edge("base", [turned(0.5, 0.2)])}
    with pytest.raises(UsageError, match=r"'hand' in 'map' within 83.9 m .* frames.origin_m does that"):
        FrameTree(edges, "map").at("hand", [0])
    pose, known = FrameTree(edges, "map", (x, y, -0.1)).at("hand", [0])
    assert known.all()
    right = turned(0.5, 0.2)
    right[2, 3] = 0.1
    torch.testing.assert_close(pose[0], right, atol=1e-9, rtol=0)


def test_circles_of_frames_are_named():
    edges = {"a": edge("b", [turned(0, 0)]), "b": edge("a", [turned(0, 0)])}
    with pytest.raises(UsageError, match="circle"):
        FrameTree(edges, "a").at("a", [0])


@pytest.mark.parametrize("mesh", [False, True])
def test_wrenches_become_touches(mesh, bags, tmp_path, recorded):
    """A ball, or a cube of its width, on a sensor that is pressed on from the side; load and bias are taken off."""
    text = """
schema = 1
[topics]
"/wrench" = "wrench"
[frames]
world = "base"
tool = "sensor"
[scene]
builtin = "box"
within = [[-1, -1, -1], [1, 1, 1]]
[wrench]
radius_m = 0.0125
center_m = [0.0, 0.0, 0.05]
mass_kg = 0.2
mass_center_m = [0.0, 0.0, 0.02]
tare_s = 0.5
[actions]
view_s = 0.5
every_s = 0.5
instants = 5
"""
    if mesh:
        import trimesh

        # turned by 90 degrees about x, with its middle 50 mm along its own y
        cube = trimesh.creation.box((25.0, 25.0, 25.0))
        cube.apply_translation((0.0, 20.0, 0.0))
        cube.export(tmp_path / "cube.stl")
        shape = f'mesh = "{tmp_path / "cube.stl"}"\nscale = 0.001\nrpy_deg = [90, 0, 0]\n'
        text = text.replace("radius_m = 0.0125\n", shape).replace("[0.0, 0.0, 0.05]", "[0.0, 0.0, 0.03]")
    mapping = mapping_of(text)
    weight = torch.tensor([0.0, 0.0, -0.2 * 9.81, 0.0, 0.0, 0.0])
    bias = torch.tensor([1.0, -2.0, 0.5, 0.01, 0.02, -0.03])
    force = torch.tensor([-3.0, 0.0, 0.0])
    point = torch.tensor([0.0125, 0.0, 0.05])
    pressed = torch.cat((force, torch.linalg.cross(point, force)))
    maker = bags.Maker(tmp_path / "bag")
    maker.tf(bags.START, "base", "sensor", turned(0.3, 0.0))
    for index in range(20):
        stamp = bags.START + index * bags.SECOND // 10
        maker.tf(stamp + 1, "base", "sensor", turned(0.3, 0.0))
        felt = pressed if 10 <= index < 15 else torch.zeros(6)
        if index == 12:
            felt = pressed + torch.tensor([0.0, 0, 0, 0, 5.0, 0])  # of no touch of the ball
        maker.wrench("/wrench", stamp, "sensor", (weight + bias + felt).tolist())
    import_bag(maker.close(), mapping, tmp_path / "log.h5")
    with Log(tmp_path / "log.h5") as opened:
        made = make_readings(opened, mapping)
    assert made.wrenches["contact"] == 4 and made.wrenches["none"] == 15
    surface = torch.cat(
        [one.reading.observation.points[one.reading.observation.of_class(Semantics.SURFACE)] for one in made.taken]
    )
    torch.testing.assert_close(surface, torch.tensor([[0.3125, 0.0, 0.05]]).expand(4, 3), atol=1e-4, rtol=0)
    assert sum(int(one.reading.in_contact.sum()) for one in made.taken) == 5
