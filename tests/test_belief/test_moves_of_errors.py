"""Moves of systematic errors: they keep prior and posterior, and weigh anew what they change."""

from dataclasses import replace

import pytest
import torch

from rumi.belief.pose_trajectories import PHYSICS, Trajectories
from rumi.belief.rival_filters import _FromStarts
from rumi.belief.systematic_errors import SIZE, VIEW, WEAR, SystematicErrors
from rumi.belief.trajectory_history import History, Kind, Segment
from rumi.belief.trajectory_moves import Moves
from rumi.seeding import generator
from tests.fixtures.errors_of_a_run import (
    DOUBLE,
    EXACT,
    OWN,
    history_of_a_push,
    numbers,
    particles,
    replayed,
    sensed,
)

pytestmark = pytest.mark.usefixtures("by_numba")


def test_what_is_translated_with_the_tool_and_the_view_fits_as_before(model):
    """Object, tool and view go together, so that no reading of a tool that does not turn tells of it."""
    history = history_of_a_push()
    yaw = torch.tensor([0.0, 0.0, 2.0]) + torch.tensor([0.0, 0.0, 0.05]) * (history.tool[..., 2:] == 0)
    history = replace(history, tool=history.tool + yaw)
    history = history.appended(sensed(torch.zeros(1, 2, 3, **DOUBLE), (Kind.SEEN,), pushes=False, seed=5))
    own = replace(OWN, tool_off_rad=0.0)
    given = replayed(model, own, particles(history, 400, numbers(400)))
    after = Moves(model, own, generator(6)).translated(given, history)
    went = after.poses - given.poses
    moved = went[:, 0].abs().amax(-1) > 0
    assert float(moved.double().mean()) > 0.95
    assert float(went[moved][:, 0, :2].norm(dim=-1).median()) > 1e-3
    torch.testing.assert_close(went[:, -1], went[:, 0], atol=1e-6, rtol=0)  # the push is the same
    torch.testing.assert_close(after.log_likelihood, given.log_likelihood, atol=2e-3, rtol=2e-4)
    before, errors = (SystematicErrors.of(own, part.systematic) for part in (given, after))
    taken = torch.tensor([0.2, -0.1, 2.05], **DOUBLE)
    there = errors.tool(taken)[:, :2] - before.tool(taken)[:, :2]
    torch.testing.assert_close(there, went[:, 0, :2], atol=1e-12, rtol=0)
    shown = errors.seen(after.poses[:, 0]) - before.seen(given.poses[:, 0])
    torch.testing.assert_close(shown, torch.zeros_like(shown), atol=1e-12, rtol=0)


def test_where_a_view_is_believed_to_be_off_otherwise_the_object_stays_where_it_shows_it(model):
    history = history_of_a_push()
    given = replayed(model, OWN, particles(history, 400, numbers(400)))
    after = Moves(model, OWN, generator(6)).erred(given, history)
    off = (after.systematic != given.systematic)[:, VIEW:].any(-1)
    before, errors = (SystematicErrors.of(OWN, part.systematic) for part in (given, after))
    went = (after.poses - given.poses)[:, 0, :2].norm(dim=-1)
    assert int(off.sum()) > 40 and float(went[off].median()) > 5e-4 and float(went[~off].max()) == 0.0
    torch.testing.assert_close(errors.seen(after.poses[:, 0]), before.seen(given.poses[:, 0]), atol=1e-12, rtol=0)


@pytest.mark.parametrize("begins", ["view", "views", "free", "push"])
@pytest.mark.parametrize("moves", [Moves, _FromStarts])
def test_what_errors_change_is_weighed_anew_however_the_history_begins(model, moves, begins):
    """Also where start poses have a prior of their own, and stay where they are whatever the view is off by."""
    whole = history_of_a_push()
    parts = {"view": (0, 1, 2, 3), "views": (0, 0, 1, 2, 3), "free": (1, 2, 3), "push": (2, 3)}
    history = History.empty()
    for number in parts[begins]:
        history = history.appended(whole.segment(number), opens=number < 3)
    given = replace(particles(history, 300, numbers(300)), starts=torch.zeros(5, 3, **DOUBLE))
    given = replayed(model, OWN, given)
    after = moves(model, OWN, generator(6)).erred(given, history)
    assert float((after.systematic != given.systematic).any(-1).double().mean()) > 0.1
    again = replayed(model, OWN, after)
    torch.testing.assert_close(after.poses, again.poses, atol=1e-6, rtol=0)
    torch.testing.assert_close(after.log_likelihood, again.log_likelihood, atol=2e-3, rtol=2e-4)


@pytest.mark.parametrize("view", [(0.003, 0.01), (0.0, 0.01), (0.003, 0.0), (0.0, 0.0)])
@pytest.mark.parametrize("move", ["translated", "erred", "reshaped"])
def test_what_a_move_leaves_out_is_what_it_cannot_change(model, move, view):
    """Poses and likelihoods that moves keep are those of the whole history replayed; views are kept where they can."""
    history, own = history_of_a_push(), replace(OWN, view_off_m=view[0], view_off_rad=view[1])
    given = replayed(model, own, particles(history, 300, numbers(300)))
    moves = Moves(model, own, generator(6))
    after = given
    for _ in range(3):
        after = getattr(moves, move)(after, history)
    assert float((after.systematic != given.systematic).any(-1).double().mean()) > 0.3
    again = replayed(model, own, after)
    torch.testing.assert_close(after.poses, again.poses, atol=1e-6, rtol=0)
    torch.testing.assert_close(after.log_likelihood, again.log_likelihood, atol=2e-3, rtol=2e-4)


def test_a_camera_alone_tells_of_the_segments_before_the_first_of_another_kind():
    still = torch.zeros(1, 2, 3, **DOUBLE)
    view, free = (sensed(still, (kind,), pushes=False, seed=1) for kind in (Kind.SEEN, Kind.FREE))
    push = sensed(still, (Kind.SEEN,), pushes=True, seed=1)
    none, points = torch.zeros(0, dtype=torch.long), torch.zeros(0, 3, **DOUBLE)
    nothing = Segment(still, False, points, none, none, points[:, 0])
    for segments, count in (
        ((), 0),
        ((view,), 1),
        ((view, view, free, view), 2),
        ((free, view), 0),
        ((view, push, view), 1),
        ((view, nothing, view), 1),
        ((nothing, view), 0),
    ):
        history = History.empty()
        for segment in segments:
            history = history.appended(segment)
        assert history.shown() == count


@pytest.mark.parametrize("view_off_m", [0.003, 0.0])
@pytest.mark.parametrize("move", ["translated", "erred", "reshaped"])
def test_moves_of_systematic_errors_keep_their_prior(model, move, view_off_m):
    """Where nothing was sensed the numbers stay standard normal ones, and are soon others."""
    none = torch.zeros(0, dtype=torch.long)
    points = torch.zeros(0, 3, **DOUBLE)
    still = Segment(torch.zeros(1, 2, 3, **DOUBLE), False, points, none, none, points[:, 0])
    own = replace(OWN, view_off_m=view_off_m)
    history = History.empty().appended(still)
    given = replayed(model, own, particles(history, 4000, numbers(4000)))
    moves, after = Moves(model, own, generator(8)), given
    for _ in range(30):
        after = getattr(moves, move)(after, history)
    told = [WEAR, SIZE] if move == "reshaped" else [0, 1, 4, 5] if view_off_m else [0, 1]
    found, before = after.systematic[:, told], given.systematic[:, told]
    assert float((found - before).abs().mean()) > 0.5
    assert float(found.mean(0).abs().max()) < 0.06
    torch.testing.assert_close(found.std(0), torch.ones(len(told), **DOUBLE), atol=0.05, rtol=0)
    torch.testing.assert_close(after.physics[:, :PHYSICS], given.physics[:, :PHYSICS], atol=0, rtol=0)


def test_nothing_is_translated_where_the_tool_is_where_it_is_taken_to_be(model):
    history = history_of_a_push()
    given = replayed(model, EXACT, particles(history, 10, None))
    moves = Moves(model, EXACT, generator(6))
    assert moves.translated(given, history) is given and moves.erred(given, history) is given


def test_systematic_errors_move_before_anything_was_sensed(model):
    nothing = History.empty()
    given = particles(nothing, 50, numbers(50))
    after = Moves(model, OWN, generator(6)).translated(given, nothing)
    assert bool((after.poses[:, 0] != given.poses[:, 0]).any(-1).all())


def test_what_was_met_is_seen_or_felt_first():
    history = history_of_a_push()
    seen = history.points[history.kind == Kind.SEEN, :2].mean(0)
    pushed = torch.arange(len(history.points)) >= history.point_ends[history.ends[1] - 1]
    felt = (history.kind == Kind.FELT) | (history.kind == Kind.PAD_FELT)
    first = pushed & (torch.arange(len(history.points)) < history.point_ends[history.ends[2] - 1])
    torch.testing.assert_close(history.met(), torch.stack((seen, history.points[felt & first, :2].mean(0))))
    assert History.empty().met().shape == (0, 2)
    assert len(history.since(2).met()) == 1


def test_what_was_met_stays_on_the_object_as_its_size_moves(model):
    """Of a block felt at one face alone its size is open, and its middle is as much farther off that face."""
    own = replace(EXACT, size_off=0.05)
    face = torch.tensor([[-0.04, y, 0.0] for y in (-0.02, -0.01, 0.0, 0.01, 0.02)], **DOUBLE)
    still, count = torch.zeros(1, 2, 3, **DOUBLE), torch.zeros(len(face), dtype=torch.long)
    felt = Segment(still, False, face, count, count + int(Kind.FELT), torch.ones(len(face), **DOUBLE))
    history = History.empty().appended(felt)
    before = replayed(model, own, particles(history, 200, numbers(200)))
    now, moves = before, Moves(model, own, generator(7))
    for _ in range(20):
        now = moves.reshaped(now, history)

    def there(given: Trajectories) -> torch.Tensor:
        """Where the face's middle is on the object, in its model's size."""
        size = SystematicErrors.of(own, given.systematic).size
        return (given.pose[:, :2] - face.mean(0)[:2]) / size[:, None]

    torch.testing.assert_close(there(now), there(before), atol=1e-9, rtol=0)
    size = now.systematic[:, SIZE]
    assert float((size != before.systematic[:, SIZE]).double().mean()) > 0.9
    assert 0.8 < float(size.std()) < 1.2 and abs(float(size.mean())) < 0.25  # one face says nothing of it
