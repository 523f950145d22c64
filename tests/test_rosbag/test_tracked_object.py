"""A recording in which another system measured the object: how it moved, and where it was."""

import pytest
import torch

from rumi.cli import main
from rumi.errors import UsageError
from rumi.rosbag.frames import FrameTree
from rumi.rosbag.mapping_file import mapping_of
from rumi.rosbag.scene import settings_of
from rumi.runs.folder import load_run

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def tracked(bags, tmp_path_factory):
    return bags.record(tmp_path_factory.mktemp("bags") / "tracked", tracked=True)


def mapping(bags, lines):
    text = bags.MAP.replace("floor_z_m = -0.2", f"floor_z_m = -0.2\n{lines}")
    return text.replace('filter.motion = "sticking"\n', "")


def test_a_frame_that_rides_with_the_object_measures_its_motion(bags, tracked, tmp_path):
    text = mapping(bags, 'motion = "mug"')
    made = bags.readings_of(tracked.bag, text, tmp_path / "log.h5")
    assert made.problems == [] and len(made.taken) == len(tracked.readings)
    for one, live in zip(made.taken[1:], tracked.readings[1:], strict=True):
        torch.testing.assert_close(one.reading.object_motion, live.object_motion, atol=2e-5, rtol=0)
    moved = torch.cat([one.reading.object_motion[-1:, :3, 3] for one in made.taken[1:]]).norm(dim=-1)
    assert float(moved.max()) > 0.005, "it was pushed"
    assert settings_of(mapping_of(text)).filter.motion == "measured"
    assert all(one.truth is None for one in made.taken)


def test_what_is_left_out_costs_no_motion(bags, tracked, tmp_path):
    """Readings of half of the length add up to the same motion, whichever poses they are cut at."""
    text = mapping(bags, 'motion = "mug"').replace("every_s = 1.1", "every_s = 0.55")
    made = bags.readings_of(tracked.bag, text, tmp_path / "log.h5")
    whole = torch.eye(4)
    for one in made.taken[1:]:
        whole = one.reading.object_motion[-1] @ whole
    torch.testing.assert_close(whole @ tracked.start, tracked.truth, atol=1e-4, rtol=0)


def test_the_object_s_frame_is_the_truth_and_judges_a_replay(bags, tracked, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "map.toml").write_text(mapping(bags, 'motion = "mug"\ntruth = "mug"'))
    assert main(["import", str(tracked.bag), "--map", "map.toml", "--out", "log.h5"]) == 0
    assert main(["replay", "log.h5", "--out", "run"]) in (0, 1)
    run = load_run("run")
    torch.testing.assert_close(run.steps[0].truth, tracked.start.float(), atol=1e-5, rtol=0)
    torch.testing.assert_close(run.steps[-1].truth, tracked.truth.float(), atol=1e-5, rtol=0)
    assert all(step.nll is not None for step in run.steps)
    assert "truth    " in capsys.readouterr().out
    best = run.steps[-1].belief.mode()
    assert float((best[:2, 3] - tracked.truth[:2, 3]).norm()) < 0.005


def test_the_belief_does_not_see_the_truth(bags, tracked, tmp_path):
    with_truth, without = (
        bags.readings_of(tracked.bag, mapping(bags, line), tmp_path / f"{at}.h5").taken
        for at, line in enumerate(('truth = "mug"', ""))
    )
    for one, other in zip(with_truth, without, strict=True):
        assert one.truth is not None and other.truth is None and one.reading.object_motion is None
        assert torch.equal(one.reading.observation.points, other.reading.observation.points)


@pytest.mark.parametrize("name", ["motion", "truth"])
def test_a_frame_that_is_not_there_is_named(name, bags, tracked, tmp_path):
    with pytest.raises(UsageError, match="no_such_frame"):
        bags.readings_of(tracked.bag, mapping(bags, f'{name} = "no_such_frame"'), tmp_path / "log.h5")


def test_a_first_view_without_the_object_is_named(bags, tracked, tmp_path, monkeypatch):
    frames = FrameTree.at

    def nowhere(self, frame, stamps_ns):
        pose, known = frames(self, frame, stamps_ns)
        return pose, known & (frame != "mug")

    monkeypatch.setattr(FrameTree, "at", nowhere)
    with pytest.raises(UsageError, match="the pose of mug, which rides with the object, at the end of the first view"):
        bags.readings_of(tracked.bag, mapping(bags, 'motion = "mug"'), tmp_path / "log.h5")


def test_a_time_without_the_object_is_left_out_and_its_motion_kept(bags, tracked, tmp_path, monkeypatch):
    frames = FrameTree.at

    def without_the_mug(self, frame, stamps_ns):  # for the third reading
        pose, known = frames(self, frame, stamps_ns)
        late = (torch.as_tensor(stamps_ns) - bags.START) / bags.SECOND
        return pose, known & ~((frame == "mug") & (late > 2.41) & (late < 3.49))

    monkeypatch.setattr(FrameTree, "at", without_the_mug)
    made = bags.readings_of(tracked.bag, mapping(bags, 'motion = "mug"'), tmp_path / "log.h5")
    assert any("which rides with the object, is not known throughout; left out" in one for one in made.problems)
    assert len(made.taken) == len(tracked.readings) - 1
    whole = torch.eye(4)
    for one in made.taken[1:]:
        whole = one.reading.object_motion[-1] @ whole
    torch.testing.assert_close(whole @ tracked.start, tracked.truth, atol=1e-4, rtol=0)
