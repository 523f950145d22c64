"""The pose filter: motion, weighing, resampling, batches, and a Kalman filter beside it."""

import math
from dataclasses import dataclass, replace

import pytest
import torch

from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterSettings, PoseFilter
from rumi.registration.descent import DescentSettings
from sdf import se3
from sdf.containers import collate, index, stack
from sdf.posed import posed_distance
from sdf.primitives import Box, Sphere
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics
from tests.fixtures.readings import make_reading

F64 = torch.float64
BOX = Box((0.04, 0.06, 0.1)).double()
MODULE = Discrepancy(BOX, 0.125, free_scale=10.0, tolerance=0.001).double()
QUIET = {"translation_noise_m": 0.0, "rotation_noise_rad": 0.0}


def planar(*xyyaw):
    return se3.from_planar(torch.tensor(xyyaw, dtype=F64), 0.1)


def reading(observation, motion=None):
    """With measured motion."""
    return make_reading(observation, motion=still(observation) if motion is None else motion, dtype=F64)


def still(observation):
    return se3.identity((*observation.points.shape[:-2], 1), dtype=F64, device="cpu")


def surface(truth, count=40, seed=0):
    random = torch.Generator().manual_seed(seed)
    points = (2 * torch.rand(count, 3, generator=random, dtype=F64) - 1) * torch.tensor([0.04, 0.06, 0.1])
    points[:, 0] = -0.04
    return Observation.of(se3.apply(truth, points), Semantics.SURFACE)


def belief(count=12, seed=0, truth=None):
    truth = planar(0.4, 0.0, 0.2) if truth is None else truth
    noise = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=F64)
    spread = noise * torch.tensor([0.005, 0.005, 0.1], dtype=F64)
    return PoseBelief.uniform(truth @ se3.from_planar(spread))


def make(**changes):
    return PoseFilter(FilterSettings(**({"trigger": 1e9} | QUIET | changes)), [MODULE], "SE(2)").double()


def run(filter_, start, memory, *readings, seed=0):
    random = torch.Generator().manual_seed(seed)
    for one in readings:
        start, memory, info = filter_(start, memory, one, generator=random)
    return start, memory, info


EMPTY = Observation.empty(dtype=F64)


def test_weights_are_the_boltzmann_posterior_of_all_points():
    truth = planar(0.4, 0.0, 0.2)
    first, second = surface(truth, 200, 1), surface(truth, 200, 2)
    after, memory, _ = run(make(), belief(), EMPTY, reading(first), reading(second))
    expected = torch.softmax(-2.0 * MODULE(belief().attached_T_object, memory), -1)
    torch.testing.assert_close(after.weights, expected)
    assert float(after.ess()) < 10


def test_only_new_points_are_weighed_while_nothing_moved_and_the_sum_is_exact():
    truth = planar(0.4, 0.0, 0.2)
    filter_ = make()
    looked_up = []
    inner = filter_.discrepancy.forward
    filter_.discrepancy.forward = lambda poses, points: looked_up.append(len(points)) or inner(poses, points)
    try:
        after, memory, _ = run(filter_, belief(), EMPTY, reading(surface(truth, 30, 1)), reading(surface(truth, 20, 2)))
    finally:
        del filter_.discrepancy.forward
    assert looked_up[0] == 30
    assert sum(looked_up) == len(memory)
    torch.testing.assert_close(after.discrepancy, MODULE(after.attached_T_object, memory))


def test_a_measured_motion_costs_nothing_and_keeps_every_weight():
    truth = planar(0.4, 0.0, 0.2)
    before, memory, _ = run(make(), belief(), EMPTY, reading(surface(truth)))
    motion = se3.exp(torch.tensor([0.05, -0.02, 0.0, 0.0, 0.0, 0.4], dtype=F64))
    after, kept, info = run(make(), before, memory, reading(EMPTY, motion[None]))
    assert bool(info.moved)
    torch.testing.assert_close(after.discrepancy, before.discrepancy)
    torch.testing.assert_close(after.weights, before.weights)
    torch.testing.assert_close(after.world_T_object, motion @ before.world_T_object)
    torch.testing.assert_close(kept.points, memory.points)


def test_a_motion_that_tasks_settle_is_refused():
    box = Box((0.04, 0.04, 0.04))
    with pytest.raises(ValueError, match="got 'auto', which tasks settle"):
        PoseFilter(FilterSettings(motion="auto"), [Discrepancy(box, 0.04)], "SE(2)")


def test_points_are_attached_at_their_own_instants():
    truth = planar(0.4, 0.0, 0.2)
    path = se3.exp(
        torch.linspace(0, 1, 4, dtype=F64)[:, None] * torch.tensor([0.06, 0.0, 0.0, 0.0, 0.0, 0.3], dtype=F64)
    )
    points, instant = [], []
    for k in range(4):
        points.append(surface(path[k] @ truth, 10, k))
        instant.append(torch.full((10,), k))
    seen = make_reading(concatenate(points), motion=path, instant=torch.cat(instant), dtype=F64)
    after, memory, _ = run(make(), PoseBelief.uniform(truth[None]), EMPTY, seen)
    assert len(memory) == 40
    assert float(after.discrepancy) < 1e-9


def test_golden_merge_free_points_that_ride_keep_every_cost(golden):
    case = golden("rumi.merge")
    inputs, expected = case["inputs"], case["expected"]
    old, motion = torch.tensor(inputs["W_T_O_old"], dtype=F64), torch.tensor(inputs["M"], dtype=F64)
    free, seen = (torch.tensor(inputs[k], dtype=F64) for k in ("free", "surface"))
    sphere = Sphere(inputs["sphere_radius"]).double()
    torch.testing.assert_close(se3.apply(motion, seen), torch.tensor(expected["surface_new"], dtype=F64))
    before, after = posed_distance(sphere, old, free), posed_distance(sphere, motion @ old, free)
    torch.testing.assert_close(before, torch.tensor(expected["sdf_old"], dtype=F64), atol=1e-12, rtol=0)
    torch.testing.assert_close(after, torch.tensor(expected["sdf_new"], dtype=F64), atol=1e-12, rtol=0)
    assert (after > 0).all(0).tolist() == expected["keep_printed"]
    # the filter deletes nothing: free points ride along, so that what refuted a particle still does
    module = Discrepancy(sphere, inputs["sphere_radius"]).double()
    filter_ = PoseFilter(FilterSettings(trigger=1e9, **QUIET), [module], "SE(2)").double()
    first = reading(Observation.of(free, Semantics.FREE))
    start, memory, _ = run(filter_, PoseBelief.uniform(old), EMPTY, first)
    moved, kept, _ = run(filter_, start, memory, reading(EMPTY, motion[None]))
    assert len(kept) == len(memory)
    torch.testing.assert_close(moved.weights, start.weights)
    assert float(start.weights.max() - start.weights.min()) > 1e-3


def test_golden_merge_free_points_that_stay_are_dropped_as_printed(golden):
    case = golden("rumi.merge")
    inputs, expected = case["inputs"], case["expected"]
    old, motion = torch.tensor(inputs["W_T_O_old"], dtype=F64), torch.tensor(inputs["M"], dtype=F64)
    free = torch.tensor(inputs["free"], dtype=F64)
    module = Discrepancy(Sphere(inputs["sphere_radius"]).double(), inputs["sphere_radius"]).double()
    settings = FilterSettings(trigger=1e9, free_points="dropped", **QUIET)
    filter_ = PoseFilter(settings, [module], "SE(2)").double()
    start, memory, _ = run(
        filter_, PoseBelief.uniform(old), EMPTY, reading(Observation.of(free, Semantics.FREE)), reading(EMPTY)
    )
    assert len(memory) == sum(all(v > 0 for v in point) for point in zip(*expected["sdf_old"], strict=True))
    assert float(start.weights.max() - start.weights.min()) < 1e-12  # what refuted a particle is gone a step later
    start, memory, _ = run(filter_, PoseBelief.uniform(old), EMPTY, reading(Observation.of(free, Semantics.FREE)))
    _, kept, _ = run(filter_, start, memory, reading(EMPTY, motion[None]))
    assert not bool(kept.attached.any())
    torch.testing.assert_close(kept.points, free[torch.tensor(expected["keep_printed"])])


def test_a_free_point_stays_where_it_is_once_the_action_that_saw_it_is_over():
    """Seen before the object moves by 60 mm it goes along until then, and no more in the next action."""
    module = Discrepancy(Sphere(0.02).double(), 0.02).double()
    filter_ = PoseFilter(FilterSettings(trigger=1e9, free_points="dropped", **QUIET), [module], "SE(2)").double()
    seen = Observation.of(torch.tensor([[0.1, 0.0, 0.0]], dtype=F64), Semantics.FREE)
    pushed = torch.stack([planar(0.0, 0.0, 0.0), planar(0.06, 0.0, 0.0)])
    early = replace(reading(seen, pushed), instant=torch.zeros(1, dtype=torch.long))
    start, memory, _ = run(filter_, PoseBelief.uniform(planar(0.0, 0.0, 0.0)[None]), EMPTY, early)
    _, kept, _ = run(filter_, start, memory, reading(EMPTY, pushed[1:]))
    for found in (memory, kept):
        assert not bool(found.attached.any())
        torch.testing.assert_close(found.points, torch.tensor([[0.16, 0.0, 0.0]], dtype=F64))


def test_world_fixed_points_are_weighed_anew_after_a_move():
    floor = Observation.of(torch.tensor([[0.45, 0.0, 0.1]], dtype=F64), Semantics.FREE, attached=False)
    start, memory, _ = run(make(), belief(1, truth=planar(0.3, 0.0, 0.0)), EMPTY, reading(floor))
    assert float(start.discrepancy) == 0.0
    motion = se3.from_planar(torch.tensor([0.13, 0.0, 0.0], dtype=F64))
    after, _, _ = run(make(), start, memory, reading(EMPTY, motion[None]))
    assert float(after.discrepancy) > 0.05


def test_a_bad_fit_is_resampled_and_repaired():
    truth = planar(0.4, 0.0, 0.2)
    off = PoseBelief.uniform(truth @ se3.from_planar(torch.tensor([[0.02, 0.0, 0.1]] * 20, dtype=F64)))
    view = concatenate([surface(truth, 300, s) for s in (1, 2)])
    after, memory, info = run(make(trigger=1.0, translation_noise_m=0.002), off, EMPTY, reading(view))
    assert bool(info.resampled)
    assert float(after.discrepancy.max()) < 0.1 * float(MODULE(off.attached_T_object, memory).min())
    torch.testing.assert_close(after.weights, torch.softmax(-2.0 * MODULE(after.attached_T_object, memory), -1))


def test_the_order_of_the_paper_leaves_equal_weights():
    truth = planar(0.4, 0.0, 0.2)
    settings = {
        "trigger": 0.01,
        "weigh_before_resampling": False,
        "translation_noise_m": 0.01,
        "trigger_percentile": 1.0,
    }
    adam = DescentSettings(method="adam", iterations=10)
    after, _, info = run(make(descent=adam, **settings), belief(), EMPTY, reading(surface(truth)))
    assert bool(info.resampled)
    torch.testing.assert_close(after.weights, torch.full((12,), 1 / 12, dtype=F64))


def test_incremental_weighing_counts_evidence_once_and_scratch_twice():
    # 1-D Gaussian in disguise: many particles along x, one flat face seen once, then resampled
    count = 4000
    x = torch.linspace(-0.02, 0.02, count, dtype=F64)
    pose = se3.from_planar(torch.stack((0.4 + x, 0 * x, 0 * x), -1), 0.1)
    seen = Observation.of(
        torch.tensor([[0.36, y, 0.1] for y in (-0.03, 0.0, 0.03)], dtype=F64).repeat(20, 1)
        + torch.tensor([0.0, 0.0, 1.0]) * torch.linspace(-0.09, 0.09, 60, dtype=F64)[:, None],
        Semantics.SURFACE,
    )
    spread = {}
    for weighing in ("incremental", "scratch"):
        none = DescentSettings(iterations=0)
        filter_ = make(weighing=weighing, descent=none, trigger=1e-6, peakiness=30.0)
        after, memory, info = run(filter_, PoseBelief.uniform(pose), EMPTY, reading(seen))
        assert bool(info.resampled)
        offset = after.attached_T_object[:, 0, 3] - 0.4
        spread[weighing] = float((after.weights * offset.abs()).sum())
    points = 30.0 * len(memory)
    # E|x| of a Laplace posterior exp(-points |x|) is 1/points, of its square half of that
    assert spread["incremental"] == pytest.approx(1 / points, rel=0.1)
    assert spread["scratch"] == pytest.approx(0.5 / points, rel=0.1)


def test_against_a_kalman_filter_on_a_linear_gaussian_toy():
    """A belief over x alone, moved by noisy known motions and seen through Gaussian evidence."""

    @dataclass(frozen=True)
    class Gaussian:
        at: float

        def log_likelihood(self, pose):
            return -0.5 * ((pose[..., 0, 3] - self.at) / 0.01) ** 2

    class Position:
        """Each measurement for itself: what came before is in the weights already."""

        def update(self, evidence, reading, world_T_attached):
            return Gaussian(float(reading.configuration[0] - world_T_attached[-1, 0, 3]))

    random = torch.Generator().manual_seed(0)
    count = 40000
    x = 0.02 * torch.randn(count, generator=random, dtype=F64)
    start = PoseBelief.uniform(se3.from_planar(torch.stack((x, 0 * x, 0 * x), -1)))
    filter_ = make(translation_noise_m=0.005, weighing="incremental").with_evidence(Position())
    mean, variance = 0.0, 0.02**2
    memory = EMPTY
    for step, at in zip((0.01, 0.02, -0.015), (0.015, 0.02, 0.02), strict=True):
        motion = se3.from_planar(torch.tensor([step, 0.0, 0.0], dtype=F64))
        measured = replace(reading(EMPTY, motion[None]), configuration=torch.full((3,), at, dtype=F64))
        start = replace(start, discrepancy=torch.zeros_like(start.discrepancy))
        start, memory, _ = filter_(start, memory, measured, generator=random)
        mean, variance = mean + step, variance + 0.005**2
        gain = variance / (variance + 0.01**2)
        mean, variance = mean + gain * (at - mean), (1 - gain) * variance
    here = start.world_T_object[:, 0, 3]
    found = float((start.weights * here).sum())
    assert found == pytest.approx(mean, abs=4e-4)
    assert float((start.weights * (here - found) ** 2).sum()) == pytest.approx(variance, rel=0.06)


def test_a_row_of_a_batch_equals_the_scene_alone():
    truths = [planar(0.4, 0.0, 0.2), planar(0.5, -0.1, -1.0), planar(0.3, 0.2, 2.0)]
    seen = [concatenate([surface(t, 200, s) for s in (1, 2)]) for s, t in enumerate(truths)]
    starts = [belief(10, s, t) for s, t in enumerate(truths)]
    starts[0] = PoseBelief.uniform(truths[0].expand(10, 4, 4))
    starts[1] = PoseBelief.uniform(
        starts[1].attached_T_object @ se3.from_planar(torch.tensor([0.02, 0.0, 0.0], dtype=F64))
    )

    def stack(kind, parts):
        names = [name for name in kind.__dataclass_fields__ if name != "evidence"]
        return kind(*(torch.stack([getattr(p, n) for p in parts]) for n in names))

    filter_ = make(trigger=3.0, translation_noise_m=0.003)
    motion = torch.stack([planar(0.01 * s, 0.0, 0.0) @ se3.inverse(planar(0.0, 0.0, 0.0)) for s in range(3)])[:, None]
    batch = reading(stack(Observation, seen), motion)
    rows = [torch.Generator().manual_seed(s) for s in range(3)]
    together, memory, info = filter_(
        stack(PoseBelief, starts), Observation.empty((3,), dtype=F64), batch, generator=rows
    )
    assert len(set(info.resampled.tolist())) == 2
    for row in range(3):
        alone, kept, own = run(filter_, starts[row], EMPTY, reading(seen[row], motion[row]), seed=row)
        assert bool(own.resampled) == bool(info.resampled[row])
        torch.testing.assert_close(together.attached_T_object[row], alone.attached_T_object, atol=1e-9, rtol=0)
        torch.testing.assert_close(together.log_weights[row], alone.log_weights, atol=1e-7, rtol=0)
        torch.testing.assert_close(memory.points[row][memory.valid[row]], kept.points)


def test_many_steps_of_a_batch_are_those_of_each_scene():
    # one scene moves, one is resampled, one does neither: none of them draws for another
    truths = [planar(0.4, 0.0, 0.2), planar(0.5, -0.1, -1.0), planar(0.3, 0.2, 2.0)]
    starts = [belief(10, s, t) for s, t in enumerate(truths)]
    starts[0] = PoseBelief.uniform(truths[0].expand(10, 4, 4))
    starts[2] = PoseBelief.uniform(truths[2].expand(10, 4, 4))
    filter_, still = make(trigger=3.0, translation_noise_m=0.003), torch.eye(4, dtype=F64)[None]
    pushed = planar(0.01, 0.0, 0.1) @ se3.inverse(planar(0.0, 0.0, 0.0))
    pushes = [[pushed[None], still, still], [still] * 3, [still] * 3]
    alone, together, memory = [], stack(starts), Observation.empty((3,), dtype=F64)
    readings = [
        [reading(surface(truths[row], 200, 10 * step + row), pushes[row][step]) for step in range(3)]
        for row in range(3)
    ]
    for row in range(3):
        own, seen, random = starts[row], EMPTY, torch.Generator().manual_seed(row)
        for one in readings[row]:
            own, seen, _ = filter_(own, seen, one, generator=random)
        alone.append((own, seen))
    rows = [torch.Generator().manual_seed(row) for row in range(3)]
    for step in range(3):
        batch = collate([readings[row][step] for row in range(3)])
        together, memory, info = filter_(together, memory, batch, generator=rows)
        assert info.moved.tolist() == [step == 0, False, False]
    for row, (own, seen) in enumerate(alone):
        found = index(together, row)
        torch.testing.assert_close(found.attached_T_object, own.attached_T_object, atol=1e-10, rtol=0)
        torch.testing.assert_close(found.log_weights, own.log_weights, atol=1e-8, rtol=0)
        assert torch.equal(memory.points[row][memory.valid[row]], seen.points)


@pytest.mark.parametrize(("percentile", "expected"), [(0.9, False), (1.0, True)])
def test_one_particle_that_fits_badly_triggers_only_where_the_worst_counts(percentile, expected):
    truth = planar(0.4, 0.0, 0.2)
    poses = truth.expand(20, 4, 4).clone()
    poses[7, 0, 3] += 0.05
    filter_ = make(trigger=1.0, trigger_percentile=percentile)
    _, _, info = run(filter_, PoseBelief.uniform(poses), EMPTY, reading(surface(truth, 200, 1)))
    assert bool(info.resampled) is expected


def test_one_particle_and_no_points():
    after, _, info = run(make(translation_noise_m=0.003, trigger=1.0), belief(1), EMPTY, reading(EMPTY))
    assert not bool(info.moved)
    assert math.isfinite(float(after.discrepancy))
