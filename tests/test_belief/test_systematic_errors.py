"""Systematic errors of particles, pads that miss an instant, and the search of starts at every yaw."""

import math
from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch

from rumi.belief.pose_trajectories import NOISE, PHYSICS, Trajectories
from rumi.belief.pushed_object import PushedObject
from rumi.belief.rival_filters import _FromStarts
from rumi.belief.systematic_errors import NUMBERS, SIZE, VIEW, SystematicErrors
from rumi.belief.trajectory_history import History, Kind, Segment
from rumi.belief.trajectory_likelihood import told_by_silence
from rumi.belief.trajectory_moves import Moves
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.belief.yaw_search import all_round
from rumi.seeding import generator
from rumi.sim.sensor_settings import SensorSettings
from rumi.sim.tool_offset import ToolOffset
from rumi.sim.view_faults import taken_pose
from sdf import backend, se3
from sdf.primitives import Box
from sdf.so3 import wrap

DOUBLE = {"dtype": torch.float64}
EXACT = PoseTrajectorySettings(particles=60)
OWN = replace(
    EXACT,
    tool_off_m=0.002,
    tool_off_rad=0.02,
    worn=(0.001, 0.001),
    size_off=0.02,
    view_off_m=0.003,
    view_off_rad=0.01,
    view_about_m=(0.1, -0.2),
    missed=0.05,
    dead=0.1,
    least_m=0.001,
)


@pytest.fixture(autouse=True)
def compiled_versions() -> Iterator[None]:
    with backend.force("numba"):
        yield


def numbers(count: int, seed: int = 3) -> torch.Tensor:
    return torch.randn(count, NUMBERS, generator=generator(seed), **DOUBLE)


def sensed(path: torch.Tensor, kinds: tuple[Kind, ...], *, pushes: bool, seed: int) -> Segment:
    """Random points of some kinds at random instants; what is silent comes last of its instant."""
    random, count = generator(seed), 24
    points = 0.1 * (torch.rand(count, 3, generator=random, **DOUBLE) - 0.5)
    kind = torch.tensor(kinds)[torch.randint(len(kinds), (count,), generator=random)]
    instant = torch.randint(len(path), (count,), generator=random)
    order = (2 * instant + (kind == Kind.PAD_SILENT)).argsort(stable=True)
    weight = torch.rand(count, generator=random, **DOUBLE)
    return Segment(path, pushes, points, instant[order], kind[order], weight)


def history_of_a_push() -> History:
    """A view, then a tool that comes along x and pushes the block's face."""
    x = -0.11 + 0.006 * torch.arange(9, **DOUBLE)
    tool = torch.stack((x, 0 * x + 0.01, 0.05 * torch.ones_like(x)), -1)
    path = torch.stack((tool[:-1], tool[1:]), 1)
    felt = (Kind.FELT, Kind.PAD_FELT, Kind.PAD_CLEAR, Kind.PAD_SILENT)
    view = sensed(torch.zeros(1, 2, 3, **DOUBLE), (Kind.SEEN,), pushes=False, seed=1)
    free = sensed(torch.zeros(1, 2, 3, **DOUBLE), (Kind.FREE,), pushes=False, seed=4)
    history = History.empty().appended(view).appended(free)
    return history.appended(sensed(path[:4], felt, pushes=True, seed=2)).appended(
        sensed(path[4:], felt, pushes=True, seed=3), opens=False
    )


def particles(history: History, count: int, errors: torch.Tensor | None) -> Trajectories:
    random = generator(9)
    start = 0.004 * torch.randn(count, 3, generator=random, **DOUBLE)
    return Trajectories.drawn(start, history, random, systematic=errors)


def replayed(model: PushedObject, own: PoseTrajectorySettings, given: Trajectories) -> Trajectories:
    return given.replayed(model, own, given.history, torch.zeros(len(given), dtype=torch.long))


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
@pytest.mark.parametrize("move", ["translated", "erred"])
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
@pytest.mark.parametrize("move", ["translated", "erred"])
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
    told = [0, 1, 4, 5] if view_off_m else [0, 1]
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
