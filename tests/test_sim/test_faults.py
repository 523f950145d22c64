"""Faults of simulated runs: each changes the readings as it says, and what cannot be is refused."""

import math
from dataclasses import replace

import pytest
import torch

from rumi import exit_codes
from rumi.cli import main
from rumi.errors import UsageError
from rumi.runs.folder import load_run
from rumi.sim.faults import FAULTS, parse_fault
from rumi.sim.reshaped import resized
from rumi.tasks.rummage.build import faults_of, make_task
from rumi.tasks.rummage.scenes import SCENES
from rumi.tasks.rummage.settings import preset
from sdf import se3
from sdf.drill import Drill
from sdf.primitives import Box, Mug, Sphere
from sensors.semantics import Semantics

pytestmark = pytest.mark.sim

AHEAD = torch.tensor([1.0, 0.0, 0.1])
SPEC = replace(SCENES["mug-0"], start=(0.40, 0.0, 0.3))


@pytest.fixture
def follow(arm_tool, mug):
    """The task and the results of a few actions towards the mug, the first view first."""

    def run(*texts, actions=2, control=AHEAD, **changes):
        faults = [parse_fault(text, steps=40, seed=5) for text in texts]
        task = make_task(replace(SPEC, **changes), tool=arm_tool, model=mug, faults=faults)
        return task, [task.reset(0), *(task.step(control) for _ in range(actions))]

    return run


@pytest.fixture(scope="module")
def usual(arm_tool, mug):
    """The same without a fault."""
    task = make_task(SPEC, tool=arm_tool, model=mug)
    return [task.reset(0), *(task.step(AHEAD) for _ in range(2))]


def surface(result):
    return result.reading.observation.points[result.reading.observation.of_class(Semantics.SURFACE)]


def same(first, second):
    one, two = first.reading, second.reading
    return one.observation.points.equal(two.observation.points) and one.tool_pose.equal(two.tool_pose)


def test_a_knock_moves_the_object_before_its_action_and_no_sensor_says_so(follow, usual):
    task, knocked = follow("knock:30@2")
    assert same(usual[1], knocked[1])
    pushed = knocked[2].reading.object_motion[-1]
    moved = se3.to_planar(se3.inverse(pushed) @ knocked[2].truth) - se3.to_planar(knocked[1].truth)
    assert float(moved[:2].norm()) == pytest.approx(0.030, abs=1e-3)
    assert abs(float(moved[2])) <= math.radians(30.5)
    assert float(knocked[2].truth[2, 2]) > 0.999
    assert task.reset(0).truth.equal(usual[0].truth)  # a run begins without what the last one did


def test_a_knock_does_not_put_the_object_into_the_tool(follow):
    task, _ = follow()
    for seed in range(4):
        fault = parse_fault("knock:40@3", steps=40, seed=seed)
        fault.strike(task.world, task.model.exact, task._hand())
        hand = task._hand()
        object_T_tool = se3.inverse(task.world.world_T_object()).float() @ hand.world_T_tool
        assert float(task.model.exact.distance(se3.apply(object_T_tool, hand.body)).min()) > 0


def test_an_absent_object_is_never_felt(follow, usual):
    assert any(bool(result.reading.in_contact.any()) for result in usual)
    _, absent = follow("absent@1")
    assert not any(bool(result.reading.in_contact.any()) for result in absent)
    assert same(usual[0], absent[0])


def test_a_camera_that_looks_again_sees_through_where_an_absent_object_was(follow, mug):
    away = torch.zeros_like(AHEAD)
    (_, usual), (_, absent) = (follow(*texts, looks_again=True, control=away) for texts in ((), ("absent@1",)))
    was = usual[1].truth
    for found, gone in ((usual[1], False), (absent[1], True)):
        seen = found.reading.observation
        assert (len(surface(found)) == 0) == gone
        free = seen.points[seen.of_class(Semantics.FREE)]
        inside = mug.exact.distance(se3.apply(se3.inverse(was), free)) < -1e-3
        assert bool(inside.any()) == gone


def test_an_object_of_another_size_is_seen_and_felt_so(follow, mug):
    task, larger = follow("scale:10", actions=0)
    assert task.model.exact.height == pytest.approx(1.1 * mug.exact.height)
    local = se3.apply(se3.inverse(larger[0].truth), surface(larger[0]))
    assert float(task.model.exact.distance(local).abs().max()) < 1e-3
    assert float(mug.exact.distance(local).max()) > 3e-3


def test_a_hand_that_is_off_reports_all_that_it_feels_so(follow, usual):
    _, off = follow("hand:6")
    assert same(usual[0], off[0])
    for one, two in zip(usual[1:], off[1:], strict=True):
        apart = two.reading.tool_pose[:, :3, 3] - one.reading.tool_pose[:, :3, 3]
        torch.testing.assert_close(apart.norm(dim=-1), torch.full((len(apart),), 0.006), atol=1e-5, rtol=0)
        torch.testing.assert_close(
            two.reading.observation.points - one.reading.observation.points,
            apart[one.reading.instant],
            atol=1e-5,
            rtol=0,
        )
        assert one.reading.in_contact.equal(two.reading.in_contact)


def test_a_camera_that_is_off_moves_the_view_alone(follow, usual):
    _, off = follow("camera:10", actions=1)
    moved = off[0].reading.observation.points - usual[0].reading.observation.points
    torch.testing.assert_close(moved.norm(dim=-1), torch.full((len(moved),), 0.010), atol=1e-5, rtol=0)
    torch.testing.assert_close(moved, moved[:1].expand_as(moved), atol=1e-5, rtol=0)
    assert all(one.reading.tool_pose.equal(two.reading.tool_pose) for one, two in zip(usual[:2], off, strict=True))


def test_a_stale_camera_repeats_its_view(follow):
    (_, usual), (_, stale) = follow(looks_again=True), follow("stale@2", looks_again=True)
    assert same(usual[1], stale[1])

    def looked(result, count):
        return result.reading.observation.points[-count:]

    first = stale[1].reading.observation.points
    count = 1000  # of the last points, which the camera saw
    assert looked(stale[2], count).equal(first[-count:])
    assert not looked(usual[2], count).equal(first[-count:])


def test_a_dead_hand_feels_nothing_and_sweeps_as_before(follow, usual):
    _, dead = follow("dead@1")
    for one, two in zip(usual[1:], dead[1:], strict=True):
        assert not bool(two.reading.in_contact.any()) and len(surface(two)) == 0
        free = one.reading.observation.of_class(Semantics.FREE)
        assert one.reading.observation.points[free].equal(two.reading.observation.points)
        assert one.truth.equal(two.truth)


def test_false_contacts_come_at_their_rate_on_the_pads(follow):
    task, results = follow("false-contact:1", control=-AHEAD, actions=1)
    for result in results[1:]:
        (instant,) = result.reading.in_contact.nonzero()[:, 0].tolist()
        points = se3.apply(se3.inverse(result.reading.tool_pose[instant]), surface(result))
        assert float(torch.cdist(points, task._hand().pads).amin(-1).max()) < 1e-4
    _, rare = follow("false-contact:0.001", control=-AHEAD)
    assert not any(bool(result.reading.in_contact.any()) for result in rare)


def test_a_stuck_hand_feels_the_same_pads_at_every_instant(follow):
    _, stuck = follow("stuck@2", control=-AHEAD)
    assert not bool(stuck[1].reading.in_contact.any()) and bool(stuck[2].reading.in_contact.all())
    reading, points = stuck[2].reading, surface(stuck[2])
    own = se3.apply(se3.inverse(reading.tool_pose), points.view(len(reading.tool_pose), -1, 3))
    torch.testing.assert_close(own, own[:1].expand_as(own), atol=1e-5, rtol=0)


def test_a_second_object_is_felt_where_it_stands_and_moves_nothing(follow, usual):
    met = []
    for size in (60.0, 120.0):
        _, beside = follow(f"second:{size:g}@1")
        assert all(one.truth.equal(two.truth) for one, two in zip(usual, beside, strict=True))
        for one, two in zip(usual, beside, strict=True):
            more = surface(two)[: len(surface(two)) - len(surface(one))]
            apart = (more[:, :2] - usual[0].truth[:2, 3]).norm(dim=-1)
            assert bool((apart > 1e-3 * size - 0.025).all()) and bool((apart < 1e-3 * size + 0.025).all())
            met.append(len(more))
    assert sum(met) > 0


def test_friction_and_mass_change_at_their_action(follow):
    task, _ = follow("friction:2@2", "mass:4@2", actions=1)
    geom, body = task.world.model.geom_friction, task.world.model.body("object").id
    rough, heavy = float(geom[0, 0]), float(task.world.model.body_mass[body])
    moved_by_force = task.world.model.body_invweight0[body].copy()
    task.step(AHEAD)
    # what contacts are scaled by goes with it: else a heavy object is flung about
    assert task.world.model.body_invweight0[body] == pytest.approx(moved_by_force / 4, rel=1e-6)
    assert float(geom[0, 0]) == pytest.approx(2 * rough)
    assert float(task.world.model.body_mass[body]) == pytest.approx(4 * heavy)
    task.reset(0)
    assert float(task.world.model.geom_friction[0, 0]) == pytest.approx(rough)


def test_the_same_seed_gives_the_same_faulted_run(follow):
    texts = ("knock@2", "false-contact:0.5", "hand")
    (_, first), (_, again) = follow(*texts), follow(*texts)
    assert all(same(one, two) for one, two in zip(first, again, strict=True))


@pytest.mark.parametrize("shape", [Box((0.1, 0.05, 0.2)), Mug(), Drill()])
def test_shapes_in_another_size(shape):
    points = 0.2 * torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) - 0.1
    torch.testing.assert_close(
        resized(shape, 1.3).distance(1.3 * points), 1.3 * shape.distance(points), atol=1e-6, rtol=0
    )


def test_what_cannot_be_is_refused_with_words():
    with pytest.raises(UsageError, match="other sizes"):
        resized(Sphere(0.1), 1.1)
    for text, message in (
        ("gremlin", "There is no fault 'gremlin'; there are knock, absent"),
        ("knock:much", r"Expected SIZE \(mm\) as a number"),
        ("knock:0", "above 0 mm and up to 200"),
        ("knock:nan", "as a number"),
        ("scale:0", "above -50 % and up to 100"),
        ("absent:3", "without a size"),
        ("knock@x", "whole number"),
        ("knock@-1", "whole number"),
        ("knock@0", "from 1 to 10"),
        ("scale@2", "from 0 to 0"),
        ("knock@11", "up to 10, the run's last"),
    ):
        with pytest.raises(UsageError, match=message):
            parse_fault(text, steps=10)
    with pytest.raises(UsageError, match="looks again"):
        faults_of(SCENES["mug-0"], preset(task="mug-0", fault=("stale",)))


def test_every_fault_has_words_and_usual_numbers():
    for name in FAULTS:
        kind = FAULTS[name]
        assert kind.description and (math.isnan(kind.usual[0]) or (kind.unit and "SIZE" in kind.description))
        assert isinstance(parse_fault(name, steps=40), kind)


def test_the_command_line_takes_several_and_records_them(tmp_path, capsys):
    out = tmp_path / "run"
    few = ["--preset", "fast", "--steps", "1", "--no-figures", "--out", str(out)]
    main(["run", "mug-0", *few, "--fault", "hand:5", "--fault", "dead@1"])
    assert load_run(out).settings["fault"] == ["hand:5", "dead@1"]
    capsys.readouterr()
    for wrong in ("gremlin", "knock@2", "knock:-3@1"):
        assert main(["run", "mug-0", *few, "--fault", wrong]) == exit_codes.BAD_INPUT
        assert capsys.readouterr().err.startswith("rumi: ")
