"""Suggested mappings: a rod on a force sensor, a tracked block, the tool's way, found in a bag of known geometry."""

import math
import os
from pathlib import Path

import pytest
import torch

from rumi.cli import main
from rumi.exit_codes import DONE
from rumi.rosbag.mapping_file import mapping_of
from rumi.rosbag.suggest import suggest_mapping
from scripts import recorded_bags
from sdf import se3
from tests.fixtures.bags import SECOND, START, BagMaker

pytest.importorskip("rosbags")

LEVER_M, BLOCK = 0.15, (0.5, 0.1)
DOWN = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))  # a sensor whose z points down


def placed(*position, turn=DOWN):
    pose = turn.clone()
    pose[:3, 3] = torch.tensor(position, dtype=torch.float64)
    return pose


def pushed(folder, *, tool="tip", tool_m=0.0, tracked=True, wrench=True, camera=False, metres=0.2):
    """A rod goes along y over two seconds, pushes from half a second on, and a tracked block is pushed with it."""
    bag = BagMaker(folder)
    for k in range(41):
        stamp, part = START + k * SECOND // 20, k / 40
        touching = part > 0.25
        bag.tf(stamp, "base", "arm", placed(0.4, metres * part, 0.3))
        bag.tf(stamp, "arm", "sensor", placed(0.0, 0.0, 0.02, turn=se3.identity(dtype=torch.float64)))
        bag.tf(stamp, "sensor", tool, placed(0.0, 0.0, tool_m, turn=se3.identity(dtype=torch.float64)))
        if tracked:
            moved = metres * max(0.0, part - 0.25)
            bag.tf(stamp, "base", "block", placed(BLOCK[0], BLOCK[1] + moved, 0.1, turn=torch.eye(4).double()))
        if wrench:
            force = torch.tensor([0.6, 0.8, 0.0]) * (2.0 + math.sin(k)) if touching else torch.zeros(3)
            moment = torch.linalg.cross(torch.tensor([0.0, 0.0, LEVER_M]), force)
            biased = torch.cat((force, moment)) + torch.tensor([0.1, -0.2, 0.3, 0.01, 0.0, 0.0])
            for topic in ("/raw", "/thinned") if k % 2 == 0 else ("/raw",):
                bag.wrench(topic, stamp, "sensor", biased.tolist())
        if camera:
            bag.cloud("/points", stamp, "base", torch.rand(4, 3).numpy())
    return bag.close()


def suggested(tmp_path, **options):
    text = suggest_mapping(pushed(tmp_path / "bag", **options))
    return mapping_of(text), text


def test_a_rod_reaches_as_far_as_its_forces_act(tmp_path):
    found, text = suggested(tmp_path)
    assert found.frames.world == "base" and found.frames.tool == "rod_end"
    (end,) = found.fixed
    assert (end.parent, end.child) == ("tip", "rod_end")
    assert end.position_m == pytest.approx((0.0, 0.0, LEVER_M + 0.02), abs=1e-3)
    assert found.tool.off_m == 0.0055 and "no better: put in 0" in text  # of the tracker
    for table in (found.tool, found.wrench):
        assert table.radius_m == 0.005
    assert found.wrench.rod_m[1] == pytest.approx(end.position_m)
    assert found.tool.rod_m[1] == pytest.approx((0.0, 0.0, -end.position_m[2]))
    assert found.frames.floor_z_m == pytest.approx(0.3 - 0.02 - end.position_m[2] - 0.01, abs=2e-3)
    # of two streams of one sensor the one with more messages
    assert {name: topic.role for name, topic in found.topics.items()} == {"/raw": "wrench"}
    assert "the same as /raw" in text


def test_a_tool_at_the_end_of_its_rod_needs_no_further_frame(tmp_path):
    found, _ = suggested(tmp_path, tool_m=LEVER_M + 0.02)
    assert found.frames.tool == "tip" and not found.fixed
    assert found.tool.rod_m[1] == pytest.approx((0.0, 0.0, -LEVER_M - 0.02), abs=1e-3)


def test_a_gripper_is_taken_for_no_rod(tmp_path):
    found, text = suggested(tmp_path, tool="gripper")
    assert found.frames.tool == "gripper" and found.wrench is None and found.tool.rod_m is None
    assert "# [wrench]  # TODO" in text


def test_what_is_tracked_judges_and_tells_the_first_place(tmp_path):
    found, _ = suggested(tmp_path)
    assert found.frames.truth == "block" and found.frames.motion is None
    assert found.scene.prior_mean_m == pytest.approx(BLOCK) and found.scene.prior_spread_m == 0.01
    (low, high), way = found.scene.within, ((0.4, 0.0), (0.4, 0.2), BLOCK)
    assert all(low[axis] < place[axis] < high[axis] for place in way for axis in (0, 1))


def test_without_a_tracker_the_tools_way_tells_where_the_object_may_be(tmp_path):
    found, text = suggested(tmp_path, tracked=False, metres=0.4)
    assert found.frames.truth is None and "# truth" in text
    assert found.scene.prior_mean_m == pytest.approx((0.4, 0.2)) and found.scene.prior_spread_m == 0.1
    assert found.tool.off_m == 0.0 and found.wrench.level


def test_where_a_camera_sees_the_object_no_prior_is_made_up(tmp_path):
    found, _ = suggested(tmp_path, camera=True)
    assert found.scene.prior_mean_m is None and found.tool.off_m == 0.0


def test_without_forces_nothing_is_said_of_them(tmp_path):
    found, text = suggested(tmp_path, wrench=False)
    assert found.frames.tool == "tip" and found.wrench is None and "[wrench]" not in text


@pytest.mark.data
@pytest.mark.slow
def test_of_a_recorded_bag_three_commands_and_the_rods_radius_give_a_picture(tmp_path, monkeypatch, cache):
    """All eleven by `python -m scripts.recorded_bags suggested`."""
    if not os.environ.get("RUMI_DATA"):
        pytest.skip("RUMI_DATA is not set")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RUMI_CACHE", str(cache))
    bag = min(recorded_bags.bags(), key=lambda one: one.stat().st_size)
    recorded_bags.make_meshes()
    tried = recorded_bags.suggested(bag, steps=2)
    assert tried.lines <= 10
    assert Path("found/figures/overview.png").is_file()
    assert main(["result", "found"]) == DONE
