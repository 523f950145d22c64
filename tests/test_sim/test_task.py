"""A simulated task: what its readings say is true, and the same seed says the same."""

import math
from dataclasses import fields, replace

import pytest
import torch

from rumi.errors import UsageError
from rumi.sim.settings import SimSettings
from rumi.tasks.rummage.build import make_task
from rumi.tasks.rummage.scenes import SCENES
from sdf import se3
from sensors.observation import attach
from sensors.semantics import Semantics

pytestmark = pytest.mark.sim

AHEAD = torch.tensor([1.0, 0.0, 0.1])
SPEC = replace(SCENES["mug-0"], start=(0.40, 0.0, 0.3))


@pytest.fixture
def task(arm_tool, mug):
    return make_task(SPEC, tool=arm_tool, model=mug)


def changed(arm_tool, mug, settings=None, **spec):
    return make_task(replace(SPEC, **spec), settings, tool=arm_tool, model=mug)


def signed_distances(task, result):
    """Exact signed distance of every point at its own instant."""
    reading = result.reading
    motion = reading.object_motion
    poses = motion @ se3.inverse(motion[-1]) @ result.truth
    local = se3.apply(se3.inverse(poses)[reading.instant], reading.observation.points[:, None])[:, 0]
    return task.model.exact.distance(local)


def test_what_a_plan_promises_at_the_limit_the_robot_does(arm_tool, generator):
    """By parts the arm once stayed where a whole action slides on: plans promised, over and over, what none did."""
    low, high = arm_tool.bounds
    place = low + torch.rand(4000, 2, generator=generator) * (high - low)
    now = torch.cat((place, torch.rand(4000, 1, generator=generator) * 2.0 - 1.0), -1)
    now = now[arm_tool.reach.reachable(now)]
    controls = torch.rand(len(now), 1, 3, generator=generator) * 2.0 - 1.0
    whole = arm_tool.free_path(now, controls, 1)[:, -1]
    stopped = (whole - now - controls[:, 0] * arm_tool.scale).norm(dim=-1) > 1e-3
    assert int(stopped.sum()) > 100
    ends = arm_tool.free_path(now[stopped], controls[stopped], 20)[:, -1]
    assert float(((ends - whole[stopped]).norm(dim=-1) < 1e-6).float().mean()) > 0.98  # all but past the arm's base


def test_first_view(task):
    result = task.reset(0)
    reading = result.reading
    assert reading.tool_pose.shape == (1, 4, 4) and reading.in_contact.tolist() == [False]
    assert not bool(reading.instant.any())
    torch.testing.assert_close(reading.configuration, torch.tensor(SPEC.tool_start))
    torch.testing.assert_close(se3.to_planar(result.truth), torch.tensor(SPEC.start))
    distance = signed_distances(task, result)
    seen = reading.observation
    assert int(seen.of_class(Semantics.SURFACE).sum()) > 1000
    assert float(distance[seen.of_class(Semantics.SURFACE)].abs().max()) < 0.001
    assert int(seen.of_class(Semantics.FREE).sum()) > 10000
    assert float(distance[seen.of_class(Semantics.FREE)].min()) > 0
    assert seen.points.dtype == torch.float32 and bool(seen.attached.all())


def test_readings_are_true_while_pushing(task):
    """Surface points are within 3 mm of the object, free ones farther out, each at its own instant."""
    task.reset(0)
    touched = 0
    for _ in range(4):
        result = task.step(AHEAD)
        reading = result.reading
        distance = signed_distances(task, result)
        surface = reading.observation.of_class(Semantics.SURFACE)
        free = reading.observation.of_class(Semantics.FREE)
        if bool(surface.any()):
            assert float(distance[surface].abs().max()) < 0.003 + 2e-5
        assert float(distance[free].min()) > 0.003 - 2e-5
        counts = torch.zeros(20, dtype=torch.long).index_add_(
            0, reading.instant[surface], torch.ones_like(reading.instant[surface])
        )
        assert torch.equal(counts > 0, reading.in_contact)
        touched += int(reading.in_contact.sum())
        assert reading.tool_pose.shape == (20, 4, 4) and reading.object_motion.shape == (20, 4, 4)
    assert touched > 20


def test_all_pad_points_near_the_object_are_reported(task):
    """Against every pad point at every instant, without any culling."""
    task.reset(0)
    task.step(AHEAD)
    result = task.step(AHEAD)
    reading = result.reading
    motion = reading.object_motion
    poses = motion @ se3.inverse(motion[-1]) @ result.truth
    pads = task.tool.shape.pad_shell(task.settings.pad_spacing_m).float()
    local = se3.apply(se3.inverse(poses) @ reading.tool_pose, pads)
    distance = task.model.exact.distance(local).abs()
    surface = reading.observation.of_class(Semantics.SURFACE)
    clear = (distance - 0.003).abs() > 2e-5
    reported = torch.bincount(reading.instant[surface], minlength=20)
    least, most = ((distance < 0.003) & clear).sum(-1), ((distance < 0.003) | ~clear).sum(-1)
    assert bool(((reported >= least) & (reported <= most)).all()) and int(reported.sum()) > 100


def test_motion_carries_everything_to_one_frame(task):
    """With the measured motion, surface points of a push lie on the object as it stood at the start."""
    first = task.reset(0)
    attached = se3.identity()
    for _ in range(4):
        result = task.step(AHEAD)
        motion = result.reading.object_motion
        carried = attach(result.reading.observation, result.reading.instant, motion @ attached)
        attached = motion[-1] @ attached
        surface = carried.points[carried.of_class(Semantics.SURFACE)]
        if len(surface):
            local = se3.apply(se3.inverse(first.truth), surface)
            assert float(task.model.exact.distance(local).abs().max()) < 0.003 + 5e-5
    torch.testing.assert_close(attached @ first.truth, result.truth, atol=1e-5, rtol=0)
    assert float(result.truth[0, 3]) > SPEC.start[0] + 0.02


def test_motion_is_the_worlds(task):
    before = task.reset(0).truth
    for _ in range(3):
        result = task.step(AHEAD)
        motion = result.reading.object_motion
        torch.testing.assert_close(motion[-1] @ before, result.truth, atol=1e-4, rtol=0)
        before = result.truth


def test_free_points_are_sparse_and_near(task):
    """One a cell of the lattice in the object's frame, within the stated region."""
    first = task.reset(0)
    low, high = task._camera.region
    attached = se3.identity()
    for _ in range(3):
        result = task.step(AHEAD)
        motion = result.reading.object_motion
        carried = attach(result.reading.observation, result.reading.instant, motion @ attached)
        attached = motion[-1] @ attached
        free = carried.points[carried.of_class(Semantics.FREE)]
        cells = torch.floor(free / task.settings.free_spacing_m).long()
        # rounding of the two ways to the same point may tip a few over a border
        assert len(torch.unique(cells, dim=0)) > 0.97 * len(cells)
        slack = task.settings.free_spacing_m
        assert bool(((free >= low - slack) & (free <= high + slack)).all())
    seen = first.reading.observation
    assert float(low[2]) == 0.0 and float(high[2]) >= float(seen.points[seen.of_class(Semantics.SURFACE)][:, 2].max())


def test_tool_ends_where_the_planner_thinks(task, arm_tool):
    """Without contact the gripper ends an action where `free_path` says, limits of the arm included."""
    generator = torch.Generator().manual_seed(3)
    far = make_task(replace(SPEC, start=(0.05, -0.35, 0.0)), tool=arm_tool, model=task.model)
    far.reset(0)
    now = far.step(torch.tensor([1.0, 1.0, 0.0])).reading.configuration
    refused = 0
    for _ in range(10):
        control = torch.rand(3, generator=generator) * torch.tensor([1.2, 1.0, 2.0]) - torch.tensor([0.1, 0.2, 1.0])
        expected = arm_tool.free_path(now, control.clamp(-1, 1)[None], far.settings.mini_steps)[-1]
        result = far.step(control)
        now = result.reading.configuration
        assert float((now - expected)[:2].norm()) < 0.001
        assert float((now - expected)[2].abs()) < math.radians(0.5)
        refused += float(result.reading.clipped) > 0.01
        assert not bool(result.reading.in_contact.any())
    assert refused >= 2


def test_out_of_reach_is_clipped_and_reported(task, arm_tool):
    task = changed(arm_tool, task.model, start=(0.3, 0.35, 0.0), tool_start=(0.58, 0.0, 0.0))
    task.reset(0)
    reading = task.step(torch.tensor([1.0, 0.0, 0.0])).reading
    moved = float(reading.configuration[0]) - 0.58
    assert 0.0 < moved < 0.03
    assert float(reading.clipped) == pytest.approx(0.08 - moved, abs=0.002)
    inward = task.step(torch.tensor([-1.0, 0.0, 0.0])).reading
    assert float(inward.clipped) == 0.0


def test_controls_are_cut_to_one(arm_tool, mug):
    ends = []
    for scale in (1.0, 5.0):
        task = changed(arm_tool, mug)
        task.reset(0)
        ends.append(task.step(torch.tensor([scale, 0.0, 0.0])).reading.configuration)
    assert torch.equal(*ends)


def same(first, second):
    for field in fields(first):
        a, b = getattr(first, field.name), getattr(second, field.name)
        if isinstance(a, torch.Tensor):
            assert torch.equal(a, b), field.name
        elif field.name == "observation":
            same(a, b)
        else:
            assert a == b


NOISE = {"motion_noise_m": 0.001, "motion_noise_rad": 0.02, "depth_noise_m": 0.0005}


@pytest.mark.parametrize("noise", [{}, NOISE])
def test_same_seed_same_bytes(arm_tool, mug, noise):
    runs = []
    for _ in range(2):
        task = changed(arm_tool, mug, **noise)
        runs.append([task.reset(7), *(task.step(AHEAD) for _ in range(3))])
    task = changed(arm_tool, mug, **noise)
    task.reset(1)
    task.step(AHEAD)
    runs.append([task.reset(7), *(task.step(AHEAD) for _ in range(3))])
    for other in runs[1:]:
        for first, second in zip(runs[0], other, strict=True):
            same(first.reading, second.reading)
            assert torch.equal(first.truth, second.truth)


def test_seeds_change_the_noise_alone(arm_tool, mug):
    noisy = changed(arm_tool, mug, **NOISE)
    views, motions, truths = [], [], []
    for seed in (0, 1):
        views.append(noisy.reset(seed).reading.observation.points[:500])
        for _ in range(3):
            result = noisy.step(AHEAD)
        motions.append(result.reading.object_motion[-1])
        truths.append(result.truth)
    assert not torch.equal(views[0], views[1]) and not torch.equal(motions[0], motions[1])
    assert torch.equal(truths[0], truths[1])
    clean = changed(arm_tool, mug)
    same(clean.reset(0).reading, clean.reset(1).reading)


def test_motion_noise_has_its_size(arm_tool, mug):
    noisy = changed(arm_tool, mug, motion_noise_m=0.002)
    errors = []
    for seed in range(12):
        noisy.reset(seed)
        before = noisy.step(AHEAD).truth
        result = noisy.step(AHEAD)
        errors.append((result.reading.object_motion[-1] @ before - result.truth)[:2, 3])
    spread = torch.stack(errors).square().mean().sqrt()
    assert 0.001 < float(spread) < 0.0035


def test_depth_noise_has_its_size(arm_tool, mug):
    clean, noisy = changed(arm_tool, mug), changed(arm_tool, mug, depth_noise_m=0.001)
    clean.reset(0), noisy.reset(0)
    (exact, _), (measured, _) = clean.depth_image(), noisy.depth_image()
    finite = torch.isfinite(exact)
    assert float((measured - exact)[finite].std()) == pytest.approx(0.001, rel=0.05)
    assert torch.equal(torch.isfinite(measured), finite)


def test_motion_sensing_can_be_off(arm_tool, mug):
    blind = changed(arm_tool, mug, SimSettings(measures_motion=False))
    assert blind.reset(0).reading.object_motion is None
    for _ in range(3):
        reading = blind.step(AHEAD).reading
    assert reading.object_motion is None
    assert bool(reading.in_contact.any())
    # what is swept while nothing is touched is reported once; the instants with contact stand for themselves
    free = reading.observation.of_class(Semantics.FREE)
    assert int(free.sum()) > 1000


def test_paper_settings_reach_farther(arm_tool, mug):
    """95 % of the depth leaves more room before the mug than the margin of 10 mm."""
    paper = changed(arm_tool, mug, SimSettings(free_fraction=0.95)).reset(0).reading.observation
    default = changed(arm_tool, mug).reset(0).reading.observation
    assert int(paper.of_class(Semantics.FREE).sum()) < int(default.of_class(Semantics.FREE).sum())


def test_gripper_before_the_camera_is_neither_object_nor_free(arm_tool, mug):
    near = changed(arm_tool, mug, tool_start=(0.20, 0.0, 0.0), camera=replace(SPEC.camera, position=(-0.1, 0.0, 0.06)))
    result = near.reset(0)
    seen = result.reading.observation
    distance = signed_distances(near, result)
    assert float(distance[seen.of_class(Semantics.SURFACE)].abs().max()) < 0.001
    palm = (
        near.tool.shape.volume(0.005).float() @ result.reading.tool_pose[0, :3, :3].T
        + result.reading.tool_pose[0, :3, 3]
    )
    free = seen.points[seen.of_class(Semantics.FREE)]
    inside = torch.cdist(free, palm).amin(-1) < 0.002
    assert not bool(inside.any())


def test_steps_end(arm_tool, mug):
    task = changed(arm_tool, mug, steps=2)
    with pytest.raises(UsageError, match="reset"):
        task.step(AHEAD)
    task.reset(0)
    task.step(AHEAD), task.step(AHEAD)
    with pytest.raises(UsageError, match="at most 2 steps of mug-0"):
        task.step(AHEAD)
    task.reset(0)
    task.step(AHEAD)
    task.close()
    with pytest.raises(UsageError, match="reset"):
        task.step(AHEAD)


@pytest.mark.parametrize("control", [[math.nan, 0.0, 0.0], [0.0, math.inf, 0.0], [0.0, 0.0], [0.0] * 4])
def test_bad_control(task, control, no_shape_check):
    task.reset(0)
    with pytest.raises(ValueError, match="control"):
        task.step(torch.tensor(control))
