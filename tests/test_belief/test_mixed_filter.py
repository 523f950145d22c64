import pytest
import torch
from torch.utils import _pytree as pytree

from rumi.belief.mixed_filter import MixedFilter
from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterSettings, PoseFilter
from sdf import se3
from sdf.containers import collate, index, join
from sdf.grid_sdf import GridSDF
from sdf.primitives import Box, Mug, Sphere
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation
from sensors.reading import Reading
from sensors.semantics import Semantics

SHAPES = [Box((0.03, 0.04, 0.05)), Sphere(0.04), Mug()]
SETTINGS = FilterSettings(trigger=0.05, translation_noise_m=0.003)
FILTERS = [
    PoseFilter(SETTINGS, [Discrepancy(GridSDF.from_sdf(shape, 0.005, outer=0.04), 0.1)], "SE(2)") for shape in SHAPES
]


def scene(seed):
    """A belief and two readings of 10 to 14 points near a surface; the object moves before the second."""
    random = torch.Generator().manual_seed(seed)
    poses = se3.from_planar(0.03 * torch.randn(12, 3, generator=random), 0.0)
    readings = []
    for step in range(2):
        points = torch.nn.functional.normalize(torch.randn(10 + seed, 3, generator=random), dim=-1) * 0.045
        motion = se3.from_planar(torch.tensor([0.01 * step, 0.0, 0.1]))[None]
        count = len(points)
        readings.append(
            Reading(
                Observation.of(points, Semantics.SURFACE),
                torch.zeros(count, dtype=torch.long),
                se3.identity((1,)),
                torch.ones(1, dtype=torch.bool),
                motion,
                torch.zeros(3),
                torch.zeros(()),
                float(step),
            )
        )
    return PoseBelief.uniform(poses), readings


def test_a_row_is_the_scene_alone_by_its_objects_filter():
    of = torch.tensor([2, 0, 1, 0, 2])
    scenes, mixed = [scene(seed) for seed in range(5)], MixedFilter(FILTERS)
    belief, memory = collate([one for one, _ in scenes]), Observation.empty((5,))
    random = [torch.Generator().manual_seed(seed) for seed in range(5)]
    for step in range(2):
        batch = collate([readings[step] for _, readings in scenes])
        belief, memory, info = mixed(belief, memory, batch, of, generator=random)
    for row, (own, readings) in enumerate(scenes):
        seen, alone = Observation.empty(), torch.Generator().manual_seed(row)
        for one in readings:
            own, seen, told = FILTERS[of[row]](own, seen, one, generator=alone)
        for a, b in zip(*map(pytree.tree_leaves, (index(belief, row), own)), strict=True):
            assert torch.equal(a, b)
        assert torch.equal(memory.points[row][memory.valid[row]], seen.points)
        assert bool(info.resampled[row]) == bool(told.resampled)


def test_join_pads_and_keeps_the_order():
    batches = [collate([scene(seed)[1][0]]) for seed in (0, 3)]
    both = join(batches)
    assert both.observation.valid.sum(-1).tolist() == [10, 13] and both.stamp.tolist() == [0.0, 0.0]
    with pytest.raises(ValueError, match="at least one batch"):
        join([])


def test_numbers_that_are_no_objects_are_refused():
    belief, readings = scene(0)
    given = (collate([belief]), Observation.empty((1,)), collate(readings[:1]))
    with pytest.raises(ValueError, match="0 to 2"):
        MixedFilter(FILTERS)(*given, torch.tensor([3]), generator=[torch.Generator()])
    with pytest.raises(ValueError, match="one object or more"):
        MixedFilter([])
