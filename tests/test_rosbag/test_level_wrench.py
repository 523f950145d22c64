"""Wrenches of an upright rod: averaged, at the tool's height, and no touch where they help the rod along."""

import math

import numpy as np
import pytest
import torch

from rumi.errors import UsageError
from rumi.rosbag.contacts import smoothed
from rumi.rosbag.mapping_file import mapping_of
from rumi.rosbag.readings import make_readings
from rumi.rosbag.scene import settings_of
from rumi.rosbag.suggest_forces import forces_of
from sdf import se3
from sensors.log.reader import Log
from sensors.reading import FORCE
from sensors.semantics import Semantics
from tests.fixtures.bags import SECOND, START, BagMaker

MAP = """
schema = 1
[topics]
"/wrench" = "wrench"
[frames]
world = "base"
tool = "tip"
[scene]
builtin = "box"
within = [[-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]]
prior_mean_m = [0.5, 0.0]
prior_yaw_deg = 90.0
[tool]
radius_m = 0.005
rod_m = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.2]]
[wrench]
radius_m = 0.005
rod_m = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.2]]
tare_s = 0.2
smooth_s = 0.06
least_force_n = 0.3
level = true
[actions]
view_s = 0.2
every_s = 0.4
"""


def test_each_wrench_is_the_mean_about_it():
    stamps = torch.arange(5) * 10_000_000
    wrench = torch.tensor([0.0, 6.0, 0.0, 0.0, 3.0])[:, None].expand(5, 6)
    found = smoothed(wrench, stamps, 0.02)
    torch.testing.assert_close(found[:, 0], torch.tensor([3.0, 2.0, 2.0, 1.0, 1.5]))
    assert smoothed(wrench, stamps, 0.0) is wrench


@pytest.mark.parametrize(("force", "touches"), [(-0.8, True), (0.8, False), (-0.2, False)])
def test_a_rod_is_touched_before_it_by_what_resists_its_way(force, touches, tmp_path):
    """Moments that tell nothing are not asked; the touched point is on the side that the force comes from."""
    pytest.importorskip("rosbags")
    bag = BagMaker(tmp_path / "bag")
    for k in range(61):
        stamp, felt = START + k * SECOND // 50, force if k > 20 else 0.0
        pose = se3.from_planar(torch.tensor([0.1 * k / 50, 0.0, 0.0], dtype=torch.float64), 0.05)
        bag.tf(stamp, "base", "tip", pose)
        bag.wrench("/wrench", stamp, "tip", [felt, 0.0, 0.0, 0.0, 0.3, 0.2])
    from rumi.rosbag.bag import import_bag

    mapping = mapping_of(MAP)
    import_bag(bag.close(), mapping, tmp_path / "log.h5")
    with Log(tmp_path / "log.h5") as log:
        last = make_readings(log, mapping).taken[-1].reading
    assert bool(last.in_contact.all()) == touches and bool(last.in_contact.any()) == touches
    felt = last.observation.points[last.observation.of_class(Semantics.SURFACE)]
    assert bool(len(felt)) == touches
    if touches:
        instant = last.instant[last.observation.of_class(Semantics.SURFACE)]
        off = felt - last.tool_pose[instant, :3, 3]
        assert float((off[:, 0] - 0.005).abs().max()) < 0.005 and float(off[:, 1:].abs().max()) < 1e-5


def test_the_zero_is_between_that_of_the_start_and_that_of_a_lifted_rod(tmp_path):
    """It leans on something at first, whose force is then counted half; a short push of the arm high up counts not."""
    pytest.importorskip("rosbags")
    bag = BagMaker(tmp_path / "bag")
    for k in range(81):
        stamp, lifted = START + k * SECOND // 50, k > 55
        pose = se3.from_planar(
            torch.tensor([0.002 * min(k, 55), 0.0, 0.0], dtype=torch.float64), 0.3 if lifted else 0.05
        )
        bag.tf(stamp, "base", "tip", pose)
        felt = 2.0 if 60 < k < 65 else 0.1 if lifted else -0.3
        bag.wrench("/wrench", stamp, "tip", [felt, 0.0, 0.0, 0.0, 0.0, 0.0])
    from rumi.rosbag.bag import import_bag

    bag, forces = bag.close(), {}
    above = "tare_above_m = 0.2\n"
    for name, lines in (("start", "tare_s = 0.2\n"), ("both", f"tare_s = 0.2\n{above}"), ("lifted", above)):
        mapping = mapping_of(MAP.replace("tare_s = 0.2\n", lines))
        import_bag(bag, mapping, tmp_path / f"{name}.h5")
        with Log(tmp_path / f"{name}.h5") as log:
            reading = make_readings(log, mapping).taken[1].reading
        forces[name] = float(reading.measurements[FORCE][:, 0].mean())
    assert forces == pytest.approx({"start": 0.0, "both": -0.2, "lifted": -0.4}, abs=0.02)


def test_the_touches_of_an_upright_rod_follow_a_prior_by_trajectories():
    found = settings_of(mapping_of(MAP)).filter
    assert found.motion == "trajectory" and found.trajectories.lone
    assert settings_of(mapping_of(MAP.replace("level = true", ""))).filter.motion == "corrected"
    own = settings_of(mapping_of(f"{MAP}[settings]\nfilter.trajectories.missed = 0.4\n")).filter.trajectories
    assert own.missed == 0.4 and own.pad_m == 0.0 and own.tool_off_m == 0.0
    other = settings_of(mapping_of(f'{MAP}[settings]\nfilter.motion = "corrected"\n')).filter
    assert other.motion == "corrected" and not other.trajectories.lone


def test_how_far_off_the_tool_may_be_is_followed_or_refused():
    """The mapping's, or that of the settings of trajectories where these name one."""
    text = MAP.replace("[wrench]", "off_m = 0.004\n[wrench]")
    assert settings_of(mapping_of(text)).filter.trajectories.tool_off_m == 0.004
    asked = "[settings]\nfilter.trajectories.tool_off_m = 0.002\n"
    assert settings_of(mapping_of(text + asked)).filter.trajectories.tool_off_m == 0.002
    with pytest.raises(UsageError, match=r"tool\.off_m = 0 .* 'corrected', got 0\.004: leave it out"):
        settings_of(mapping_of(text.replace("level = true", "")))


def test_what_is_level_is_a_rod():
    with pytest.raises(Exception, match="rod"):
        mapping_of(MAP.replace("rod_m = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.2]]\ntare_s", "tare_s"))
    with pytest.raises(Exception, match="prior_mean_m"):
        mapping_of(MAP.replace("prior_mean_m = [0.5, 0.0]\n", ""))


def test_touches_are_told_from_what_shakes_the_tool_where_they_are_stronger():
    random = np.random.default_rng(0)
    stamps = np.arange(400) * 10_000_000
    at = 0.1 * np.maximum(0.0, stamps / 1e9 - 1.0)
    places = torch.tensor(np.stack((at, 0 * at, 0 * at), -1))
    noise = np.where(stamps < 1e9, 0.02, 0.1)[:, None] * random.standard_normal((400, 6))

    def found(force):
        rows = noise + np.where((stamps > 2e9)[:, None], [force, 0, 0, 0, 0, 0], 0.0)
        return forces_of(list(zip(stamps.tolist(), rows, strict=True)), torch.tensor(stamps), places)

    apart = found(0.8)
    assert apart.told and 0.1 < apart.touch_n < 0.8 and apart.noise_n == pytest.approx(0.02, rel=0.3)
    none = forces_of([], torch.tensor(stamps), places)
    assert none is None and math.isfinite(found(0.0).touch_n)


def test_faint_touches_stand_apart_from_none_though_the_rod_leans_on_something_at_first():
    """By the zero of the start alone all of its way is a touch."""
    stamps = np.arange(400) * 10_000_000
    at = 0.1 * np.maximum(0.0, stamps / 1e9 - 1.0)
    places = torch.tensor(np.stack((at, 0 * at, np.where(stamps > 3e9, 0.1, 0.0)), -1))
    noise = 0.02 * np.random.default_rng(0).standard_normal((400, 6))
    force = np.select([stamps < 1e9, stamps < 2.5e9], [0.2, 0.42], 0.0)
    rows = noise + force[:, None] * np.eye(6)[0]

    def found(places):
        return forces_of(list(zip(stamps.tolist(), rows, strict=True)), torch.tensor(stamps), places)

    lifted, level = found(places), found(places * torch.tensor([1.0, 1.0, 0.0]))
    assert lifted.told and 0.1 < lifted.touch_n < 0.32 and lifted.lifted_m is not None
    assert level.lifted_m is None and level.touch_n < 0.2
