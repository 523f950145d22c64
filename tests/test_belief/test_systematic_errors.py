"""Systematic errors of particles, pads that miss an instant, and the search of starts at every yaw."""

import math
from dataclasses import replace

import pytest
import torch

from rumi.belief.pose_trajectories import NOISE, PHYSICS, Trajectories
from rumi.belief.systematic_errors import NUMBERS, SIZE, SystematicErrors
from rumi.belief.trajectory_history import History, Kind, Segment
from rumi.belief.trajectory_likelihood import told_by_silence
from rumi.belief.yaw_search import all_round
from rumi.seeding import generator
from rumi.sim.sensor_settings import SensorSettings
from rumi.sim.tool_offset import ToolOffset
from rumi.sim.view_faults import taken_pose
from sdf import backend, se3
from sdf.primitives import Box
from sdf.so3 import wrap
from tests.fixtures.errors_of_a_run import (
    DOUBLE,
    EXACT,
    OWN,
    history_of_a_push,
    numbers,
    particles,
    replayed,
)

pytestmark = pytest.mark.usefixtures("by_numba")


def test_a_tool_is_where_the_simulator_has_it_by_where_it_is_taken_to_be():
    errors = SystematicErrors.of(OWN, numbers(5))
    taken = torch.tensor([0.3, -0.1, 0.7], **DOUBLE)
    for row in range(5):
        offset = ToolOffset(errors.tool_m[row], float(errors.tool_rad[row]))
        torch.testing.assert_close(errors.tool(taken)[row], offset.true(taken[None])[0], atol=1e-12, rtol=0)


def test_what_is_felt_is_as_far_from_the_object_by_either_pose():
    """A point of the tool is as far from the true pose, where it truly is, as from the felt one, where it is taken."""
    errors, pose = SystematicErrors.of(OWN, numbers(4)), torch.randn(4, 3, generator=generator(5), **DOUBLE)
    taken, point = torch.tensor([0.2, 0.1, -0.4], **DOUBLE), torch.tensor([[0.03, 0.02, 0.01]], **DOUBLE)
    there = se3.apply(se3.from_planar(taken), point)
    for row, tool in enumerate(errors.tool(taken)):
        true = se3.apply(se3.inverse(se3.from_planar(pose[row])), se3.apply(se3.from_planar(tool), point))
        felt = se3.apply(se3.inverse(se3.from_planar(errors.felt(pose, taken)[row])), there)
        torch.testing.assert_close(true, felt, atol=1e-12, rtol=0)


def test_a_camera_sees_the_object_where_the_simulator_has_it():
    """A camera that is taken to be elsewhere, or turned about a point, has the object as much elsewhere."""
    errors = SystematicErrors.of(OWN, numbers(5))
    pose = torch.randn(5, 3, generator=generator(5), **DOUBLE)
    for row, seen in enumerate(errors.seen(pose)):
        off = se3.from_planar(torch.cat((errors.view_m[row], errors.view_rad[row, None])))
        target = (*OWN.view_about_m, 0.3)
        taken = taken_pose(se3.from_planar(pose[row]), off, SensorSettings(), target)  # what moves with the camera
        torch.testing.assert_close(se3.from_planar(seen), taken, atol=1e-8, rtol=0)
    torch.testing.assert_close(errors.unseen(errors.seen(pose)), pose, atol=1e-12, rtol=0)


def test_the_compiled_replay_is_the_plain_one(model):
    history = history_of_a_push()
    given, found = particles(history, 40, numbers(40)), {}
    for version in ("torch", "numba"):
        with backend.force(version):
            found[version] = replayed(model, OWN, given)
    one, other = found["torch"], found["numba"]
    assert float((one.poses[:, -1, :2] - one.poses[:, 0, :2]).norm(dim=-1).max()) > 0.01  # it was pushed
    torch.testing.assert_close(one.poses, other.poses, atol=2e-7, rtol=0)
    torch.testing.assert_close(one.log_likelihood, other.log_likelihood, atol=2e-3, rtol=2e-4)


def test_no_error_is_the_exact_replay(model):
    history = history_of_a_push()
    none = replace(EXACT, tool_off_m=1e-12)
    with_errors = replayed(model, none, particles(history, 20, numbers(20)))
    without = replayed(model, EXACT, particles(history, 20, None))
    torch.testing.assert_close(with_errors.poses, without.poses, atol=1e-9, rtol=0)
    torch.testing.assert_close(with_errors.log_likelihood, without.log_likelihood, atol=1e-4, rtol=1e-5)


@pytest.mark.parametrize("version", ["torch", "numba"])
def test_a_worn_object_is_met_as_much_later_as_it_is_worn(model, version):
    own = replace(EXACT, worn=(0.004, 0.0), ahead=(0.0, 0.0), centre_m=0.0)
    tip = float(model.tool[:, 0].max())
    x = torch.tensor([-0.04 - tip - 0.001, -0.04 - tip + 0.006], **DOUBLE)
    path = torch.stack((x, 0 * x, 0 * x), -1)[None]
    none = torch.zeros(0, dtype=torch.long)
    flat = torch.zeros(0, **DOUBLE)
    history = History.empty().appended(Segment(path, True, flat.view(0, 3), none, none, flat))
    given = replace(
        particles(history, 1, torch.zeros(1, NUMBERS, **DOUBLE)),
        physics=torch.zeros(1, PHYSICS + NUMBERS, **DOUBLE),
        noise=torch.zeros(1, 1, NOISE, **DOUBLE),
        poses=torch.zeros(1, 2, 3, **DOUBLE),
    )
    with backend.force(version):
        moved = replayed(model, own, given).pose[0, 0]
        whole = replayed(model, replace(own, worn=(0.0, 0.0)), replace(given, physics=given.physics[:, :PHYSICS]))
    assert float(whole.pose[0, 0]) > 0.005
    assert float(whole.pose[0, 0] - moved) == pytest.approx(0.004, abs=8e-4)  # two fingers, settled one after the other


@pytest.mark.parametrize("version", ["torch", "numba"])
@pytest.mark.parametrize("factor", [0.96, 1.05])
def test_an_object_of_another_size_is_the_resized_one(model, version, factor):
    """Pushed and sensed as by the model in that size, whose mass is spread as before."""
    history, own = history_of_a_push(), replace(EXACT, size_off=abs(math.log(factor)))
    errors = torch.zeros(30, NUMBERS, **DOUBLE)
    errors[:, SIZE] = math.copysign(1.0, math.log(factor))
    sized = particles(history, 30, errors)
    resized = replace(model.resized(factor), spread_m=model.spread_m, centre=model.centre)
    # heights count from an origin that is higher up
    points = history.points - history.points.new_tensor([0.0, 0.0, resized.resting_m - model.resting_m])
    plain = replace(sized, physics=sized.physics[:, :PHYSICS], history=replace(history, points=points))
    with backend.force(version):
        found, expected = replayed(model, own, sized), replayed(resized, EXACT, plain)
    assert float((expected.poses[:, -1, :2] - expected.poses[:, 0, :2]).norm(dim=-1).max()) > 0.01  # it was pushed
    torch.testing.assert_close(found.poses, expected.poses, atol=2e-4, rtol=0)
    assert float((found.log_likelihood - expected.log_likelihood).abs().max()) < 0.1
    assert float((replayed(model, EXACT, plain).log_likelihood - expected.log_likelihood).abs().max()) > 1.0


def test_what_is_worn_off_lowers_what_is_above():
    """The top of a block, worn all round, lies lower by twice as much, since it stands on its worn foot."""
    errors = SystematicErrors.of(replace(EXACT, worn=(0.001, 0.0)), torch.zeros(1, NUMBERS, **DOUBLE))
    top = torch.tensor([[[0.0, 0.0, 0.03 - 0.002]]], **DOUBLE)
    block = Box([0.04, 0.06, 0.03])
    local = errors.of_the_model(top, 0.03)
    assert float(errors.size * block.distance(local.float())[0] + errors.worn_m) == pytest.approx(0.0, abs=1e-7)


def test_silence_is_never_less_likely_than_a_missed_touch():
    logs = torch.tensor([0.0, -1.0, -30.0, -1e4], **DOUBLE)
    told = told_by_silence(logs, replace(EXACT, missed=0.05), 1.0)
    assert float(told[0]) == pytest.approx(0.0, abs=1e-12)
    assert float(told[1]) == pytest.approx(math.log(0.05 + 0.95 * math.exp(-1.0)))
    torch.testing.assert_close(told[2:], torch.full((2,), math.log(0.05), **DOUBLE), atol=1e-9, rtol=0)
    assert torch.equal(told_by_silence(logs, EXACT, 1.0), logs)


def test_tempered_readings_are_the_power_of_whole_ones(model):
    """Also where pads were silent, whose likelihood is no product over points."""
    history = history_of_a_push()
    given = particles(history, 20, numbers(20))
    whole = replayed(model, OWN, given)
    part = given.replayed(model, OWN, history.tempered(0.3), torch.zeros(20, dtype=torch.long))
    torch.testing.assert_close(part.log_likelihood[:, :-1], whole.log_likelihood[:, :-1], atol=1e-4, rtol=1e-5)
    torch.testing.assert_close(part.log_likelihood[:, -1], 0.3 * whole.log_likelihood[:, -1], atol=1e-4, rtol=1e-4)


def test_a_search_all_round_finds_the_yaw_that_registration_missed(model):
    """Two sides of a block and a corner between them, seen where the block is turned by 65 degrees."""
    side = torch.linspace(-0.9, 0.9, 15, **DOUBLE)
    local = torch.cat(
        (
            torch.stack((0.04 + 0 * side, 0.06 * side, 0 * side), -1),
            torch.stack((0.04 * side, 0.06 + 0 * side, 0 * side), -1),
        )
    )
    true = torch.tensor([0.012, -0.009, math.radians(65.0)], **DOUBLE)
    points = se3.apply(se3.from_planar(true), local)
    count = len(points)
    weight = torch.full((count,), EXACT.seen_points / count, **DOUBLE)
    kind = torch.full((count,), int(Kind.SEEN))
    view = Segment(torch.zeros(1, 2, 3, **DOUBLE), False, points, torch.zeros(count, dtype=torch.long), kind, weight)
    history = History.empty().appended(view)
    wrong = torch.zeros(3, 3, **DOUBLE)
    found = all_round(wrong, history, model, OWN)
    given = Trajectories.still(found, history)
    best = found[replayed(model, EXACT, given).log_likelihood.sum(-1).argmax()]
    assert float((best[:2] - true[:2]).norm()) < 0.002
    assert abs(float(wrap(2.0 * (best[2] - true[2])[None]))) < math.radians(6.0)  # a block is the same turned by half
