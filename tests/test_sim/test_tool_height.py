"""The height of the tool: where the object is, and never where its section is empty."""

from dataclasses import replace

import pytest
import torch

from rumi.belief.pose_filter import FilterSettings
from rumi.dynamics.outline import GridOutline, slice_of, support_of
from rumi.errors import UsageError
from rumi.fields.workspace import Workspace
from rumi.robot.gripper import GripperShape
from rumi.tasks.rummage.own import rummager
from rumi.tasks.rummage.scenes import SCENES
from rumi.tasks.rummage.settings import preset
from rumi.tasks.rummage.tool_height import at_tool_height, lowest_height
from sdf.grid_sdf import GridSDF
from sdf.object_model import object_model
from sdf.primitives import Box
from sdf.symmetry import Symmetries

MUG, DRILL, BOX, SHELF = (SCENES[name] for name in ("mug-0", "drill-0", "box-0", "shelf-mug"))


def placed(spec, half, asked=None, spacing=0.002, shape=None):
    exact = Box(half)
    return at_tool_height(spec, GridSDF.from_sdf(exact, spacing), exact, asked, shape)


@pytest.mark.parametrize("spec", [MUG, SHELF], ids=lambda spec: spec.name)
@pytest.mark.parametrize("high_mm", [23.5, 24, 30, 32, 44.9, 46, 95, 200])
def test_a_level_tool_meets_every_object_that_the_pads_reach(spec, high_mm):
    half = (0.06, 0.04, 0.0005 * high_mm)
    own = placed(spec, half)
    assert own.height_m == (0.045 if high_mm > 45 else 0.023)
    assert own == replace(spec, height_m=own.height_m)
    outline = GridOutline.of_slice(GridSDF.from_sdf(Box(half), 0.002), own.height_m - half[2])
    assert float(outline(torch.zeros(2)).distance) == pytest.approx(-0.04, abs=1e-3)


def test_a_tool_in_space_comes_down_to_what_is_low():
    assert placed(DRILL, (0.05, 0.04, 0.02)) is DRILL
    for spec, high in ((DRILL, 0.025), (BOX, 0.013)):
        assert placed(spec, (0.05, 0.04, 0.5 * high)).heights_m == (0.023, 0.20)


def test_a_height_that_is_asked_for():
    assert placed(MUG, (0.03, 0.04, 0.06), 0.06).height_m == 0.06
    assert placed(MUG, (0.03, 0.04, 0.015), 0.028).height_m == 0.028
    # pads that are thinner get lower
    thin = GripperShape(palm_m=(0.09, 0.1, 0.01), pad_m=(0.035, 0.018, 0.005))
    assert lowest_height(thin) == pytest.approx(0.006)
    assert placed(MUG, (0.05, 0.05, 0.005), shape=thin).height_m == pytest.approx(0.006)


@pytest.mark.parametrize(
    ("spec", "half", "asked", "said"),
    [
        (MUG, (0.08, 0.05, 0.001), None, "more than 23 mm high, got 160 x 100 x 2 mm.*pass over: touch it from above"),
        (MUG, (0.01, 0.006, 0.01), None, "got 20 x 12 x 20 mm"),
        (DRILL, (0.08, 0.05, 0.003), None, "more than 12 mm high, got 160 x 100 x 6 mm"),
        (MUG, (0.03, 0.04, 0.06), 0.02, "from 0.023 m, .* to below 0.12 m, .* got 0.02 m"),
        (MUG, (0.03, 0.04, 0.06), 0.13, "got 0.13 m"),
        (DRILL, (0.03, 0.04, 0.06), 0.05, "moves in space, got 0.05 m"),
    ],
)
def test_heights_that_meet_nothing(spec, half, asked, said):
    with pytest.raises(UsageError, match=said):
        placed(spec, half, asked)


def test_an_own_robots_workspace_and_object_meet():
    def made(height, **settings):
        bounds = torch.tensor([[0.2, -0.2, height], [0.6, 0.2, height]])
        slab = object_model("slab", Box((0.06, 0.04, 0.015)), Symmetries.parse("x2,y2"))
        return rummager(slab, Workspace.from_bounds(bounds, 0.02, planar_height=height), settings=preset(**settings))

    assert made(0.025, filter=FilterSettings(motion="corrected")).tool.height_m == pytest.approx(0.025)
    with pytest.raises(UsageError, match=r"45 mm above the table, got 120 x 80 x 30 mm: .* another planar_height"):
        made(0.045)
    with pytest.raises(UsageError, match="no tool_height_m"):
        made(0.025, tool_height_m=0.025)


def test_walls_that_the_table_has_lost():
    """A wall of 0.8 mm between nodes 3 mm apart is nowhere below zero; with one every 0.4 mm it has an outline."""
    sheet = (0.0004, 0.05, 0.05)
    with pytest.raises(UsageError, match=r"walls 45 mm above the table.*a node every 3 mm: .* as --spacing"):
        placed(MUG, sheet, spacing=0.003)
    assert placed(MUG, sheet, spacing=0.0004) is MUG
    fine = GridSDF.from_sdf(Box(sheet), 0.0004)
    # also where the slice's own nodes lie to both sides of it
    found = slice_of(fine, 0.0, spacing=0.0013)
    assert found is not None and found[2] == 0.00065
    assert GridOutline.of_slice(fine, -0.005).radius == pytest.approx(0.05, abs=2e-3)
    assert support_of(fine).spread == pytest.approx(0.025, abs=1e-3)
