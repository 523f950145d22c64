"""Remarks on readings that nobody took: each kind where it is due, once, and never where all is as believed."""

import math
from dataclasses import replace

import pytest
import torch

from rumi.belief.frictions import Frictions, frictions_of
from rumi.belief.particles import PoseBelief
from rumi.belief.pose_trajectories import PoseTrajectoryBelief, Trajectories
from rumi.belief.remarks import Limits, held_up, remarks, tipping
from rumi.belief.trajectory_history import History
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.dynamics.along_path import Pusher
from rumi.dynamics.outline import RectangleOutline, base_of, support_of
from rumi.dynamics.pushed_body import PushedBody
from sdf import se3
from sdf.object_model import box_model
from sdf.symmetry import Symmetries
from sensors.observation import Observation
from sensors.semantics import Semantics
from tests.fixtures.readings import make_reading

BOX = box_model()  # 60 x 158 x 210 mm about its origin
HIGH = 0.105
START, GOAL = torch.tensor([0.2, 0.0, 0.0]), torch.tensor([0.28, 0.0, 0.0])


def belief(world_T_attached=None):
    """Particles a few millimetres apart about (0.4, 0), standing, in a frame that rides with the object."""
    shifts = torch.tensor([[0.4, 0.0, HIGH], [0.402, 0.001, HIGH], [0.399, -0.002, HIGH]])
    poses = se3.make(torch.eye(3), shifts)
    return PoseBelief(
        se3.identity() if world_T_attached is None else world_T_attached,
        poses,
        torch.zeros(3).log_softmax(-1),
        torch.zeros(3),
    )


def turned(axis, degrees, about):
    """World motion that turns about a level line through a point."""
    turn = se3.exp(torch.cat((torch.zeros(3), math.radians(degrees) * torch.eye(3)[axis])))
    place = se3.make(torch.eye(3), torch.tensor(about))
    return place @ turn @ se3.inverse(place)


def lifted(metres):
    return se3.make(torch.eye(3), torch.tensor([0.0, 0.0, metres]))


def points(kind, *places):
    return Observation.of(torch.tensor(places), kind)


def found(reading=None, told=None, added=None, moved=(START, GOAL), **more):
    reading = make_reading(configuration=GOAL) if reading is None else reading
    added = Observation.empty() if added is None else added
    more = {"upright": True} | more
    return [one.name for one in remarks(7, reading, told or belief(), added, BOX, moved=moved, **more)]


def pressed(reached, contact=True, motion=None, instants=5):
    tool = se3.from_planar(torch.tensor([reached, 0.0, 0.0]), 0.045).expand(instants, 4, 4)
    motion = None if motion is None else motion.expand(instants, 4, 4)
    configuration = torch.tensor([reached, 0.0, 0.0])
    return make_reading(tool=tool, contact=contact, motion=motion, configuration=configuration)


ON_EDGE = [0.43, 0.0, 0.0]  # of its base, ahead


@pytest.mark.parametrize(
    ("name", "given"),
    [
        ("resists", {"reading": pressed(0.22)}),
        ("resists", {"reading": pressed(0.22, motion=se3.identity())}),
        ("toppled", {"told": belief(turned(1, 90.0, ON_EDGE))}),
        ("lifted", {"told": belief(lifted(0.03))}),
        ("dropped", {"told": belief(lifted(-0.05))}),
        ("not there", {"added": points(Semantics.FREE, (0.4, 0.0, 0.05), (0.3, 0.0, 0.05))}),
        ("elsewhere", {"added": points(Semantics.SURFACE, (0.30, 0.0, 0.05), (0.30, 0.01, 0.05))}),
    ],
)
def test_each_where_it_is_due(name, given):
    assert found(**given) == [name]


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"moved": None, "reading": pressed(0.20)},  # nobody knows where it was to go
        {"reading": pressed(0.279)},
        {"reading": pressed(0.22, contact=False)},  # the reach may have held it
        {"reading": pressed(0.22, contact=torch.tensor([1, 1, 1, 1, 0]).bool())},
        {"told": belief(turned(1, 20.0, ON_EDGE))},
        {"told": belief(turned(1, 90.0, ON_EDGE)), "upright": False},
        {"added": points(Semantics.FREE, (0.372, 0.0, 0.05), (0.3, 0.0, 0.05))},
        {"added": points(Semantics.SURFACE, (0.366, 0.0, 0.05), (0.9, 0.0, 0.05), (0.371, 0.01, 0.05))},
        {"added": replace(points(Semantics.FREE, (0.4, 0.0, 0.05)), attached=torch.zeros(1, dtype=torch.bool))},
    ],
)
def test_nothing_where_all_is_as_believed(given):
    assert found(**given) == []


def test_what_it_says():
    (one,) = remarks(
        7, pressed(0.22, motion=lifted(0.001)), belief(), Observation.empty(), BOX, moved=(START, GOAL), upright=True
    )
    assert (one.name, one.step) == ("resists", 7)
    assert one.sentence == "the tool stopped 60 mm before its goal, pressed against the object, which moved by 1 mm"
    # a small action needs more than half of it
    near = torch.tensor([0.24, 0.0, 0.0])
    assert held_up(START, near, pressed(0.225), Limits()) is None
    assert held_up(START, near, pressed(0.21), Limits()) == (pytest.approx(0.03), None)


def test_one_particle_that_explains_is_enough():
    """Where poses are still many, a reading that one of them explains is no surprise."""
    told, raised = belief(), lifted(HIGH)[None]
    poses = torch.cat((told.attached_T_object, raised))
    told = PoseBelief(told.world_T_attached, poses, torch.zeros(4).log_softmax(-1), torch.zeros(4))
    assert found(told=told, added=points(Semantics.FREE, (0.4, 0.0, 0.05))) == []


@pytest.mark.parametrize("which", range(8))
def test_where_no_particle_is_known_to_be_best_any_may_explain(which):
    shifts = torch.tensor([[0.2 * i, 0.0, HIGH] for i in range(8)])
    poses = se3.make(torch.eye(3), shifts)
    wide = PoseBelief(se3.identity(), poses, torch.zeros(8).log_softmax(-1), torch.zeros(8))
    side = float(shifts[which, 0]) - 0.03
    added = points(Semantics.SURFACE, (side, 0.0, 0.1), (side, 0.01, 0.1))
    assert found(told=wide, added=added) == []
    ranked = replace(wide, discrepancy=(torch.arange(8) == which).float())  # it is known to be the worst
    assert found(told=ranked, added=added) == ["elsewhere"]


def test_what_looks_the_same_does_not_topple():
    """A ball rolls; so does a can that lies; one that stands topples."""
    half_over = belief(turned(1, 90.0, ON_EDGE))
    ball, can = (replace(BOX, symmetries=Symmetries.parse(words)) for words in ("ball", "z,x2"))
    lying = replace(BOX, symmetries=Symmetries.parse("y,x2"))
    said = [
        [
            one.name
            for one in remarks(
                7, make_reading(configuration=GOAL), half_over, Observation.empty(), model, moved=None, upright=True
            )
        ]
        for model in (ball, can, lying)
    ]
    assert said == [["rolled"], ["toppled"], ["rolled"]]


PADS = torch.cartesian_prod(torch.tensor([0.0]), torch.linspace(-0.02, 0.02, 6), torch.linspace(-0.02, 0.02, 11))


def pressing(low, high):
    """Pads that press against the box's near side (x = 0.37), and feel from one height to another alone."""
    tool = se3.from_planar(torch.tensor([0.371, 0.0, 0.0]), 0.045).expand(3, 4, 4)
    places = se3.apply(tool[-1], PADS)
    felt = places[(places[:, 2] >= low) & (places[:, 2] <= high)]
    reading = make_reading(tool=tool, contact=True, configuration=GOAL)
    return replace(reading, observation=Observation.of(felt, Semantics.SURFACE), instant=torch.full((len(felt),), 2))


@pytest.mark.parametrize(
    ("low", "high", "names"),
    [(0.0, 0.1, []), (0.0, 0.036, ["other height"]), (0.053, 0.1, ["other height"]), (0.0, 0.055, [])],
)
def test_heights_at_which_it_is_felt_tell_of_a_fall(low, high, names):
    """Nothing measured its motion: what stands is felt all over the pads, what lies low on them alone."""
    assert found(reading=pressing(low, high), moved=None, pads=PADS) == names
    assert found(reading=pressing(low, high), moved=None) == []


def test_a_pose_that_explains_the_heights_is_enough():
    told, down = belief(), lifted(-HIGH * 2 + 0.036)
    poses = torch.cat((told.attached_T_object, (down @ told.attached_T_object[0])[None]))
    told = PoseBelief(told.world_T_attached, poses, torch.zeros(4).log_softmax(-1), torch.zeros(4))
    assert found(reading=pressing(0.0, 0.036), told=told, moved=None, pads=PADS) == []


BASE = base_of(BOX.sdf)  # 30 mm to the edge ahead: by the prior's median it slides below 60 mm, and is not held down
PRIOR = frictions_of(belief(), PoseTrajectorySettings())


def pushed_along(way=(0.02, 0.0), height=0.13, felt=(), **given):
    share = torch.linspace(0.0, 1.0, 5)[:, None]
    path = torch.cat((torch.tensor([0.37, 0.0]) + share * torch.tensor(way), torch.zeros(5, 1)), -1)
    reading = make_reading(tool=se3.from_planar(path, height), **({"contact": True} | given), configuration=GOAL)
    points = torch.tensor(felt).reshape(-1, 3)
    return replace(
        reading,
        observation=Observation.of(points, Semantics.SURFACE),
        instant=torch.full((len(points),), 4),
    )


@pytest.mark.parametrize(
    ("given", "names"),
    [
        ({}, ["tips"]),
        ({"height": 0.07}, []),  # likelier than not, but nobody knows the friction
        ({"way": (0.0, 0.02)}, []),  # 79 mm to the edge
        ({"way": (0.001, 0.0)}, []),  # no push
        ({"contact": False}, []),
        ({"motion": se3.identity()[None].expand(5, 4, 4)}, []),
    ],
)
def test_what_is_pushed_too_high_may_fall(given, names):
    reading = pushed_along(**given)
    assert found(reading=reading, moved=None, base=BASE, frictions=PRIOR) == names
    assert found(reading=reading, moved=None, base=BASE) == []


def test_that_a_push_tips_is_a_probability_over_the_beliefs_frictions():
    reading, flat = pushed_along(height=0.08), torch.full((3,), 0.5, dtype=torch.float64)

    def share(told, *floor, felt=()):
        given = reading if not felt else pushed_along(height=0.08, felt=felt)
        frictions = Frictions(told, torch.tensor(floor, dtype=torch.float64))
        height, probability = tipping(given, belief(), BOX.surface_points, BASE, frictions, Limits())
        assert height == pytest.approx(0.08, abs=1e-4)
        return probability

    # it slides below 30 mm over 80
    assert [share(flat, 0.3), share(flat, 0.45), share(flat, 0.3, 0.45)] == [0.0, 1.0, 0.5]
    assert 0.5 < share(PRIOR.tool, *PRIOR.floor) < 0.9
    # the more the tool's friction holds down the side that it touches the less
    behind = ((0.37, 0.0, 0.08),)
    shares = [share(mu * flat, *PRIOR.floor, felt=behind) for mu in (0.0, 0.5, 1.0, 1.5)]
    assert shares == sorted(shares, reverse=True) and shares[0] > shares[-1]


@pytest.mark.parametrize(
    ("height", "before", "names"),
    [
        (0.08, ("resists",), []),
        (0.08, ("lost: none of these",), ["tips"]),
        (0.08, ("other height",), ["tips"]),
        (0.04, ("other height",), []),
    ],
)
def test_what_is_at_odds_with_the_belief_makes_a_fall_likelier(height, before, names):
    reading = pushed_along(height=height)
    assert found(reading=reading, moved=None, base=BASE, frictions=PRIOR, before=before) == names
    if names:
        given = {"added": points(Semantics.SURFACE, (0.30, 0.0, 0.05), (0.30, 0.01, 0.05)), "reading": reading}
        assert found(**given, moved=None, base=BASE, frictions=PRIOR) == ["elsewhere", "tips"]


def test_trajectories_know_their_friction_at_the_tool():
    own = PoseTrajectorySettings()
    physics, noise = torch.zeros(3, 5, dtype=torch.float64), torch.zeros(3, 2, 11, dtype=torch.float64)
    physics[:, 0] = torch.tensor([-1.0, 0.0, 1.0])
    noise[:, -1, 0] = 1.0
    poses, starts = torch.zeros(3, 3, 3, dtype=torch.float64), torch.zeros(3, 3, dtype=torch.float64)
    trajectories = Trajectories(physics, noise, poses, starts[:, :2], History.empty(), starts)
    told = belief()
    knows = PoseTrajectoryBelief(
        told.world_T_attached, told.attached_T_object, told.log_weights, told.discrepancy, trajectories=trajectories
    )
    found = frictions_of(knows, own)
    (median, deviation), change = own.friction, own.friction_change
    expected = median * (deviation * physics[:, 0] + change).exp()
    torch.testing.assert_close(found.tool, expected)
    torch.testing.assert_close(found.floor.log().mean().exp(), torch.tensor(median).double())
    fresh = replace(trajectories, noise=noise[:, :0], poses=poses[:, :1], log_likelihood=starts[:, :0])
    begun = replace(knows, trajectories=fresh)
    torch.testing.assert_close(frictions_of(begun, own).tool, median * (deviation * physics[:, 0]).exp())
    wide = own.for_others().friction[0]
    assert frictions_of(told, own).tool.tolist() == [wide] * 3


LINE = torch.linspace(-0.05, 0.05, 21)[:, None]
PALM = torch.cat((torch.zeros_like(LINE), LINE), -1)  # along the box's near side
FINGER = torch.cat((LINE + 0.05, torch.full_like(LINE, -0.0795)), -1)  # round its corner, along the other


@pytest.mark.parametrize(
    ("points", "given", "names"),
    [
        (torch.cat((PALM, FINGER)), {}, ["two contacts"]),
        (PALM, {}, []),
        (torch.cat((PALM, FINGER)), {"contact": False}, []),
        (torch.cat((PALM, FINGER)), {"way": 0.001}, []),  # no push
        (torch.cat((PALM, FINGER)), {"away": 0.01}, []),
    ],
)
def test_what_is_touched_at_two_sides_is_outside_of_the_model(points, given, names):
    own = {"contact": True, "way": 0.02, "away": 0.0} | given
    path = torch.zeros(5, 3)
    path[:, 0] = 0.3695 - own["away"] + torch.linspace(-own["way"], 0.0, 5)
    reading = make_reading(tool=se3.from_planar(path, 0.045), contact=own["contact"], configuration=GOAL)
    body = PushedBody(RectangleOutline((0.03, 0.079)), support_of(BOX.sdf), Pusher(points))
    assert found(reading=reading, moved=None, body=body) == names
    assert found(reading=reading, moved=None) == []
    fallen = belief(turned(1, 90.0, ON_EDGE))
    assert found(reading=reading, told=fallen, moved=None, body=body) == ["toppled"]
