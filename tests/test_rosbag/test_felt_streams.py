"""Touches of a wrench in a bag, with their normals: what bare points leave open they tell apart."""

import math
from dataclasses import replace

import pytest
import torch

from rumi.errors import UsageError
from rumi.rosbag.bag import import_bag
from rumi.rosbag.mapping_file import mapping_of
from rumi.rosbag.readings import make_readings
from rumi.rosbag.scene import rummager_of_map, settings_of
from rumi.runs.replay import replay
from rumi.task import TaskOnDevice
from sensors.contact_reading import ContactReading
from sensors.log.reader import Log
from sensors.reading import Reading
from sensors.semantics import Semantics

FINGER = """
schema = 1
[topics]
"/wrist" = "wrench"
[frames]
world = "base"
tool = "gripper"
[scene]
builtin = "box"
within = [[0.40, -0.20, 0.0], [0.80, 0.20, 0.30]]
prior_mean_m = [0.60, 0.0]
prior_spread_m = 0.02
[tool]
palm_m = [0.02, 0.02, 0.02]
palm_front_m = -0.01
pad_m = [0.01, 0.01, 0.01]
pad_offset_m = 0.0
[wrench]
radius_m = 0.01
center_m = [0.10, 0.0, 0.0]
force_n = 0.05
moment_nm = 0.001
[actions]
view_s = 0.2
every_s = 1.0
instants = 10
[settings]
filter.motion = "sticking"
initialise = { particles = 80 }
renewal = { starts = 400, polished = 100 }
stop.rule = "never"
"""
"""Of a ball on a stick before a box that nobody sees; the box stands along the world's axes."""

LIKELY = FINGER.replace("[wrench]", "[wrench]\nlikelihood = true")
PLACE = torch.tensor([0.54, 0.0, 0.05], dtype=torch.float64)
"""Where the box's side is touched, along x."""


@pytest.fixture(scope="module")
def poked(bags, tmp_path_factory):
    """The log of three pokes at one place of a box's side that faces the finger, with a noisy sensor."""
    folder = tmp_path_factory.mktemp("pokes")
    maker, random = bags.Maker(folder / "bag"), torch.Generator().manual_seed(1000)
    for step in range(321):
        at = step / 100
        begun = at - 0.2
        # a second each: there in 0.5 s, 0.2 s of contact, and back
        phase = begun % 1.0 if 0.0 < begun < 3.0 else 0.0
        back = 0.10 * min(1.0, max(0.0, 1.0 - phase / 0.5)) + 0.10 * max(0.0, min(1.0, (phase - 0.7) / 0.3))
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = PLACE - torch.tensor([0.11 + back, 0.0, 0.0], dtype=torch.float64)
        stamp = bags.START + step * bags.SECOND // 100
        maker.tf(stamp, "base", "gripper", pose)
        wrench = torch.randn(6, generator=random, dtype=torch.float64)
        wrench *= torch.tensor([0.05] * 3 + [0.001] * 3, dtype=torch.float64)
        if 0.5 <= phase <= 0.7:
            force = torch.tensor([-5.0, 0.5, 0.0], dtype=torch.float64)
            wrench += torch.cat((force, torch.linalg.cross(torch.tensor([0.11, 0.0, 0.0]).double(), force)))
        maker.wrench("/wrist", stamp, "gripper", wrench.numpy())
    path = folder / "log.h5"
    assert import_bag(maker.close(), mapping_of(FINGER), path).problems == []
    return path


def made_of(path, text):
    with Log(path) as log:
        made = make_readings(log, mapping_of(text))
    assert made.problems == []
    return made.taken


def replayed(path, text, wrap=lambda task: task, **changes):
    mapping, taken = mapping_of(text), made_of(path, text)
    settings = replace(settings_of(mapping), **changes)
    places = torch.cat([one.reading.tool_pose[:, :3, 3] for one in taken])
    return replay(taken, rummager_of_map(mapping, settings, places), seed=1000, wrap=wrap).last.belief


def turned(belief):
    """Degrees by which the box's nearest side is turned away from the finger, mean of the belief."""
    yaw = torch.atan2(belief.world_T_object[:, 1, 0], belief.world_T_object[:, 0, 0])
    off = torch.remainder(yaw + math.pi / 4, math.pi / 2) - math.pi / 4
    return float((belief.weights * off.abs()).sum()) * 180 / math.pi


def test_touches_come_with_normals_beside_their_points(poked):
    plain, ours = made_of(poked, FINGER), made_of(poked, LIKELY)
    assert all(type(one.reading) is Reading for one in plain) and len(plain) == len(ours) == 4
    for bare, felt in zip(plain[1:], ours[1:], strict=True):
        assert isinstance(felt.reading, ContactReading) and felt.reading.signals is None
        touch = felt.reading.wrench
        assert len(touch.points) == 3, "the surest in three parts of it"
        assert bool((touch.instant[1:] >= touch.instant[:-1]).all())
        assert bool(bare.reading.in_contact[touch.instant].all())
        assert torch.equal(felt.reading.in_contact, bare.reading.in_contact)
        torch.testing.assert_close(touch.points, PLACE.float().expand(3, 3), atol=0.003, rtol=0)
        normal = torch.tensor([-1.0, 0.0, 0.0])
        assert float((touch.normals @ normal).min()) > math.cos(math.radians(15))
        assert float(touch.point_sd.min()) > 1e-4 and float(touch.point_sd.max()) < 0.003
        seen, told = bare.reading.observation, felt.reading.observation
        assert int(seen.of_class(Semantics.SURFACE).sum()) > 10
        assert torch.equal(seen.points, told.points) and torch.equal(seen.semantics, told.semantics)
    fewer = made_of(poked, LIKELY.replace("likelihood = true", "likelihood = true\nmost = 1"))[2].reading.wrench
    every = made_of(poked, LIKELY.replace("likelihood = true", "likelihood = true\nmost = 1000"))[2].reading.wrench
    assert len(fewer.points) == 1 and len(every.points) > 10
    assert float(fewer.point_sd) == float(every.point_sd.min())


@pytest.mark.sim
def test_a_normal_tells_poses_apart_that_points_leave_open(poked):
    """Poked at one place a box may be turned by anything; the normal says that a side faces the finger."""
    points, felt = replayed(poked, FINGER), replayed(poked, LIKELY)
    assert points.evidence is None and felt.evidence is not None
    assert turned(points) > 15.0
    assert turned(felt) < 8.0
    wide = replayed(poked, LIKELY, lambda task: TaskOnDevice(task, torch.device("cpu"), torch.float64), dtype="float64")
    assert wide.log_weights.dtype == torch.float64 and turned(wide) < 8.0


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ("most = 0", "Expected most to be 1 or more, got 0"),
        ("outlier = 1.0", r"Expected outlier in \[0, 1\), got 1"),
        ("point_m = 0.0", "Expected point_m above 0 and finite, got 0"),
        ("normal_rad = -1.0", "Expected normal_rad above 0 and finite, got -1"),
        ('likelihood = "yes"', "likelihood"),
    ],
)
def test_settings_that_cannot_be_are_refused(told, message):
    with pytest.raises(UsageError, match=message):
        mapping_of(FINGER.replace("[wrench]", f"[wrench]\n{told}"))
