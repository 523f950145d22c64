"""Observations: thinning, merging and carrying them to the object's frame."""

import math
from dataclasses import replace

import pytest
import torch

from sdf import backend, se3
from sensors.observation import Observation, attach, compact, concatenate, in_world, merge, thin_mask
from sensors.semantics import Semantics

SPACING = torch.tensor([0.01, 0.01, 0.002])


def cloud(count, seed, semantics=Semantics.SURFACE):
    random = torch.Generator().manual_seed(seed)
    return Observation.of(torch.rand(count, 3, generator=random) * 0.05, semantics)


def keep_first_of_each_cell(points, spacing):
    """Reference: a dictionary from cell to its first point."""
    cells = {}
    for point in points.double().tolist():
        cells.setdefault(tuple(int(c // spacing) for c in point), point)
    return torch.tensor(list(cells.values()))


def test_thinning_keeps_the_first_raw_point_of_each_cell():
    observation = cloud(500, 0, Semantics.FREE)
    kept = observation.points[thin_mask(observation, SPACING)]
    torch.testing.assert_close(kept, keep_first_of_each_cell(observation.points, float(SPACING[0])).float())


def test_thinning_twice_is_thinning_once():
    once = compact(Observation.of(cloud(500, 1).points, Semantics.FREE))
    once = once[thin_mask(once, SPACING).nonzero()[:, 0]]
    assert thin_mask(once, SPACING).all()


def test_golden_lattice(golden):
    case = golden("rumi.downsample")
    points = torch.tensor(case["inputs"]["points"], dtype=torch.float64)
    spacing = case["inputs"]["r"]
    kept = points[thin_mask(Observation.of(points, 2), torch.full((3,), spacing, dtype=torch.float64))]
    cells = torch.floor(kept / spacing).long()
    assert sorted(cells.tolist()) == sorted(case["expected"]["cells"])


def test_merge_adds_only_new_cells_and_keeps_old_points():
    old, _ = merge(Observation.empty(), cloud(200, 2), SPACING)
    again, added = merge(old, old, SPACING)
    assert len(added) == 0
    torch.testing.assert_close(again.points, old.points)
    both, added = merge(old, cloud(200, 3), SPACING)
    torch.testing.assert_close(both.points[: len(old)], old.points)
    torch.testing.assert_close(both.points[len(old) :], added.points)
    assert len(both) == len(keep_first_of_each_cell(both.points, float(SPACING[2])))


def test_same_cell_of_another_class_or_frame_is_another_point():
    point = torch.tensor([[0.005, 0.005, 0.005]])
    parts = [Observation.of(point, s, attached=a) for s in Semantics for a in (True, False)]
    merged, _ = merge(Observation.empty(), concatenate(parts), SPACING)
    assert len(merged) == 6


def test_merge_of_a_batch_equals_each_scene_alone():
    scenes = [cloud(60, 4), cloud(60, 5)]
    more = [cloud(90, 6), cloud(90, 4)]

    def stack(parts):
        return Observation(*(torch.stack([getattr(p, n) for p in parts]) for n in Observation.__dataclass_fields__))

    together, added = merge(stack(scenes), stack(more), SPACING)
    for row in range(2):
        alone, added_alone = merge(scenes[row], more[row], SPACING)
        valid = together.valid[row]
        torch.testing.assert_close(together.points[row][valid], alone.points[alone.valid])
        torch.testing.assert_close(added.points[row][added.valid[row]], added_alone.points)


def test_padding_is_never_kept():
    observation = cloud(10, 7)
    padded = Observation(observation.points, observation.semantics, observation.attached, torch.arange(10) < 4)
    assert len(compact(padded)) == 4
    merged, _ = merge(Observation.empty(), padded, SPACING)
    assert int(merged.valid.sum()) == 4


def test_attached_points_ride_and_fixed_points_stay():
    random = torch.Generator().manual_seed(8)
    frames = se3.exp(torch.randn(4, 6, generator=random, dtype=torch.float64))
    points_a = torch.randn(12, 3, generator=random, dtype=torch.float64)
    instant = torch.arange(12) % 4
    points_w = (frames[instant][:, :3, :3] @ points_a[..., None])[..., 0] + frames[instant][:, :3, 3]
    there = attach(Observation.of(points_w, 0), instant, frames)
    torch.testing.assert_close(there.points, points_a)
    fixed = attach(Observation.of(points_w, 0, attached=False), instant, frames)
    torch.testing.assert_close(fixed.points, points_w)


def test_bad_points_are_refused_with_a_reason():
    with pytest.raises(ValueError, match="points"):
        Observation.of(torch.tensor([[0.0, float("nan"), 0.0]]), 0)
    with pytest.raises((ValueError, TypeError)):
        Observation.of(torch.zeros(5, 2), 0)


def test_empty_is_ordinary():
    empty = Observation.empty()
    merged, added = merge(empty, empty, SPACING)
    assert len(merged) == 0
    assert len(added) == 0


def test_attached_points_go_to_the_world_and_others_stay():
    points = torch.tensor([[0.1, 0.0, 0.0], [0.1, 0.0, 0.0]])
    mixed = replace(Observation.of(points, 2), attached=torch.tensor([True, False]))
    moved = in_world(mixed, se3.from_planar(torch.tensor([1.0, 2.0, math.pi / 2])))
    torch.testing.assert_close(moved.points, torch.tensor([[1.0, 2.1, 0.0], [0.1, 0.0, 0.0]]))
    assert torch.equal(moved.attached, mixed.attached)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_versions_of_a_merge_add_the_same_points(dtype):
    """Points of all classes and frames, some not valid, negative places, cells that both have."""
    random = torch.Generator().manual_seed(5)

    def mixed(count):
        points = 0.3 * torch.rand(count, 3, generator=random, dtype=dtype) - 0.1
        draws = torch.rand(3, count, generator=random)
        return Observation(points, (3 * draws[0]).long(), draws[1] < 0.5, draws[2] < 0.9)

    for sizes in ((4000, 3000), (0, 50), (50, 0), (1, 1)):
        old, new = (mixed(count) for count in sizes)
        found = []
        for version in ("torch", "numba"):
            with backend.force(version):
                found.append(merge(old, new, SPACING))
        for one, other in zip(*found, strict=True):
            for name in ("points", "semantics", "attached", "valid"):
                assert torch.equal(getattr(one, name), getattr(other, name))


def test_a_merge_refuses_points_too_far_off():
    with pytest.raises(ValueError, match="lattice cells of the origin"):
        merge(cloud(3, 0), Observation.of(torch.tensor([[0.0, 0.0, 1e6]]), Semantics.SURFACE), SPACING)


@pytest.mark.parametrize("version", ["torch", "numba"])
def test_a_merge_refuses_points_of_another_shape(no_shape_check, version):
    points = torch.zeros(5, 2)
    flat = Observation(points, points[:, 0].long(), points[:, 0] == 0, points[:, 0] == 0)
    with backend.force(version), pytest.raises(ValueError, match=r"Expected points to have shape \(\*b, M, 3\)"):
        merge(cloud(3, 0), flat, SPACING)
