import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from matplotlib.text import Text
from PIL import Image

from rumi.errors import UsageError
from rumi.runs.folder import RunRecorder, load_run
from rumi.runs.memory import memory
from rumi.runs.scene_geometry import outline_of_points
from rumi.viz import style
from rumi.viz.animation import animate
from rumi.viz.curves import apc_curve, highest_nll, nll_curve
from rumi.viz.figures import heading, make_figures, telling_steps, to_see
from rumi.viz.outlines import contours, hull, object_outline, placed
from rumi.viz.scene import information_at, interesting, scene_from_above
from rumi.viz.space import BOXES, scene_in_space, tips
from sdf import se3, so3
from tests.fixtures.made_up_run import make_up


@pytest.fixture(scope="module")
def made():
    return make_up(6, particles=20)


@pytest.fixture(scope="module")
def run(made, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    with RunRecorder(
        folder, {"task": "mug-0", "method": "rumi", "preset": "default", "seed": 1}, made.geometry
    ) as recorder:
        for step in made.steps:
            recorder(step)
        recorder.finish(made.result)
    return load_run(folder)


def area(line):
    x, y = line[:-1].T
    return 0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))


def test_a_legend_of_curves_is_within_its_figure(run, tmp_path, monkeypatch):
    kept, saved = [], style.save

    def save(figure, path, **options):
        if path.name == "curves.png":
            entries = [legend for ax in figure.axes if (legend := ax.get_legend())]
            figure.draw_without_rendering()
            kept.extend((len(each.get_texts()), each.get_window_extent().x1, figure.bbox.x1) for each in entries)
        return saved(figure, path, **options)

    monkeypatch.setattr(style, "save", save)
    wide = {"resampled": True, "nll": 1100.0, "expected_nll": 1100.0}
    make_figures(replace(run, steps=[replace(step, **wide) for step in run.steps]), tmp_path / "figures")
    assert max(count for count, _, _ in kept) == 4  # all that it may tell
    assert all(right <= width for _, right, width in kept)


def test_all_figures_are_written(run, tmp_path):
    written = make_figures(run, tmp_path / "figures")
    names = {path.name for path in written}
    assert {"curves.png", "overview.png", "run.gif", "scene_000.png", "scene_004.png", "scene_005.png"} <= names
    for path in written:
        with Image.open(path) as image:
            assert min(image.size) > 300
            assert len(set(image.convert("L").resize((64, 64)).tobytes())) > 8, f"{path.name} is blank"
    with Image.open(tmp_path / "figures" / "run.gif") as image:
        assert image.n_frames == len(run.steps)
    # another choice replaces the scenes, nothing else
    others = {"scene_from_above.png", "scene_1.png"}
    for name in others:
        (tmp_path / "figures" / name).touch()
    make_figures(replace(run, steps=run.steps[:3]), tmp_path / "figures", [2])
    assert {path.name for path in (tmp_path / "figures").glob("scene_*.png")} == {"scene_002.png", *others}


def test_the_animation_keeps_the_tool_in_sight_and_the_ending_to_the_end(run, tmp_path, monkeypatch):
    titles = []
    set_text = Text.set_text
    monkeypatch.setattr(Text, "set_text", lambda self, text: (titles.append(text), set_text(self, text))[1])
    animate(run.steps, run.geometry, tmp_path / "run.gif", heading="what", ending=" and how")
    shown = [text for text in titles if text in ("what", "what and how")]
    assert shown[-1] == "what and how" and shown.count("what") >= len(run.steps) - 1
    left, right, bottom, top = interesting(run.steps, run.geometry)
    for step in run.steps:
        (outline,) = placed(run.geometry.tool, step.reading.tool_pose[-1])[:1]
        assert ((outline >= [left, bottom]) & (outline <= [right, top])).all()


def test_a_view_in_space_where_the_object_tips(run):
    assert not tips(run.steps)
    turned = se3.make(so3.exp(torch.tensor([1.2, 0.0, 0.0])), torch.tensor([0.5, 0.0, 0.1]))
    step = replace(run.steps[-1], truth=turned)
    assert tips([replace(step, belief=replace(step.belief, world_T_attached=turned))])
    with style.figure(4, 4) as figure:
        ax = scene_in_space(step, run.geometry, figure.add_subplot(projection="3d"), (0.0, 1.0, -0.5, 0.5))
        boxes = [np.stack(line.get_data_3d(), -1) for line in ax.lines if len(line.get_data_3d()[0]) == 36]
    assert len(boxes) == min(BOXES, len(step.belief.log_weights)) + 1
    corners = torch.from_numpy(boxes[-1][~np.isnan(boxes[-1]).any(-1)])
    size = run.geometry.surface_points.amax(0) - run.geometry.surface_points.amin(0)
    assert float(torch.pdist(corners).max()) == pytest.approx(float(size.norm()), rel=1e-5)


def test_steps_that_are_not_there_are_named(run, tmp_path):
    with pytest.raises(UsageError, match="has steps 0 to 5, got 6, 9"):
        make_figures(run, tmp_path, [0, 9, 6])
    with pytest.raises(UsageError, match="nothing to draw"):
        make_figures(replace(run, steps=[]), tmp_path)


def test_figures_of_a_run_without_truth_contact_and_plan(run, tmp_path):
    first = replace(run.steps[0], truth=None, nll=None)
    written = make_figures(replace(run, steps=[first], result=None), tmp_path)
    assert all(path.stat().st_size > 0 for path in written)


def test_telling_steps_hold_the_first_contact(run):
    assert telling_steps(run) == [0, 3, 4, 5]
    assert heading(run) == "mug-0 · rumi · default, seed 1 · sure after 5 actions"
    assert "not finished" in heading(replace(run, result=None))


def test_curves_show_what_was_recorded(made):
    with style.figure(4, 3) as figure:
        ax = figure.subplots()
        assert nll_curve(made.steps, ax, threshold=20.0) is ax
        shown = {line.get_label(): line.get_ydata() for line in ax.lines}
        np.testing.assert_allclose(shown["of the true surface"], [step.nll for step in made.steps])
        np.testing.assert_allclose(shown["expected by the belief"], [step.expected_nll for step in made.steps])
        assert len(ax.patches) == sum(
            step.control is not None and bool(step.reading.in_contact.any()) for step in made.steps
        )
        ax = figure.subplots()
        apc_curve(made.steps, ax, threshold=0.005)
        (apc,) = (line.get_ydata() for line in ax.lines if line.get_label() == "APC")
        np.testing.assert_allclose(apc, [1e3 * step.apc for step in made.steps])
        assert ax.get_ylim()[1] > 5.0


def test_scene_draws_every_part_in_place(made):
    with style.figure(4, 4) as figure:
        ax = scene_from_above(made.steps, made.geometry, figure.subplots(), information=information_at(made.steps, 2))
        labels = ax.get_legend_handles_labels()[1]
        observed = ["known to be free", "felt or seen"]
        assert set(labels) == {
            *observed,
            "particles",
            "true outline",
            "tool",
            "path of the tool",
            "in contact",
            "reachability r of the tool's place",
        }
        truth = next(line for line in ax.lines if line.get_label() == "true outline").get_xydata()
        left, right, bottom, top = interesting(made.steps, made.geometry)
        assert left < truth[:, 0].min() and truth[:, 0].max() < right
        assert bottom < truth[:, 1].min() and truth[:, 1].max() < top
        assert ax.get_xlim() == (left, right)
        assert len(ax.images) == 1


def test_information_is_that_of_the_choice_to_come(made):
    torch.testing.assert_close(information_at(made.steps, 0), made.steps[1].plan.fields["information"])
    assert information_at(made.steps, len(made.steps) - 1) is None


def test_memory_moves_with_the_object(made):
    points = memory(made.steps)
    seen = len(made.steps[0].added)
    moved = se3.apply(made.steps[-1].belief.world_T_attached, made.steps[0].added.points)
    torch.testing.assert_close(points.points[:seen], moved)


def test_outline_of_a_mug(made):
    flat = se3.identity((), dtype=torch.float32)
    (line,) = object_outline(made.geometry, flat)
    bounds = made.geometry.surface_points.amin(0), made.geometry.surface_points.amax(0)
    np.testing.assert_allclose(line.min(0), bounds[0][:2], atol=2.5e-3)
    np.testing.assert_allclose(line.max(0), bounds[1][:2], atol=2.5e-3)
    turned = se3.from_planar(torch.tensor([0.3, 0.1, math.pi / 2]))
    (placed,) = object_outline(made.geometry, turned)
    np.testing.assert_allclose(placed, line @ np.array([[0.0, 1.0], [-1.0, 0.0]]) + [0.3, 0.1], atol=1e-6)
    assert area(placed) == pytest.approx(area(line))


def test_outline_of_a_tipped_object_is_the_hull_of_its_surface(made):
    tipped = se3.exp(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.4, 0.0]))
    (line,) = object_outline(made.geometry, tipped)
    points = se3.apply(tipped, made.geometry.surface_points)[:, :2].numpy()
    assert line.min(0) == pytest.approx(points.min(0), abs=1e-6)
    assert line.max(0) == pytest.approx(points.max(0), abs=1e-6)


def test_hull_of_a_square_with_points_inside():
    inside = torch.rand(50, 2, generator=torch.Generator().manual_seed(0)).numpy() * 0.9 + 0.05
    line = hull(np.concatenate((inside, [[0, 0], [1, 0], [1, 1], [0, 1]])))
    assert len(line) == 5
    assert area(line) == pytest.approx(1.0)
    np.testing.assert_array_equal(hull(np.array([[1.0, 2.0]])), [[1.0, 2.0], [1.0, 2.0]])


def test_outline_of_points_keeps_the_size_of_the_shape():
    x, y = torch.meshgrid(torch.linspace(-0.03, 0.03, 31), torch.linspace(-0.05, 0.05, 51), indexing="ij")
    points = torch.stack((x, y, 0 * x), -1).reshape(-1, 3)
    (line,) = contours(outline_of_points(points))
    np.testing.assert_allclose(line.min(0), [-0.03, -0.05], atol=1.5e-3)
    np.testing.assert_allclose(line.max(0), [0.03, 0.05], atol=1.5e-3)
    assert area(line) == pytest.approx(0.06 * 0.1, rel=0.04)


def test_an_object_that_was_taken_away_leaves_the_rest_of_the_curves_to_be_seen(made):
    expected = max(step.expected_nll for step in made.steps)
    known = max(step.nll for step in made.steps)
    assert highest_nll(made.steps, 20.0) == pytest.approx(max(expected, known, 20.0))
    gone = [*made.steps[:-1], replace(made.steps[-1], nll=5e7)]
    assert highest_nll(gone, 20.0) == pytest.approx(10.0 * max(expected, 20.0))


def test_an_overview_speaks_of_a_field_only_where_plans_rest_on_one(run):
    assert "Orange" in to_see(run)
    bare = [step if step.plan is None else replace(step, plan=replace(step.plan, fields={})) for step in run.steps]
    assert "Orange" not in to_see(replace(run, steps=bare))
