"""The filter with further evidence, and whole short runs."""

import pytest
import torch

from rumi import loop
from rumi.cli import main
from rumi.errors import UsageError
from rumi.exit_codes import BAD_INPUT, DONE, NOT_CONVERGED
from rumi.robot.gripper import GripperShape
from rumi.tasks.handle.agent import total_nll
from rumi.tasks.handle.build import build_handle
from rumi.tasks.handle.entry import short_of
from rumi.tasks.handle.grasp import handle_odds
from rumi.tasks.handle.settings import SENSORS, HandleSettings, sensors_of


def test_the_surface_is_all_around_palm_and_pads():
    shape = GripperShape()
    points = shape.surface(0.008)
    palm = shape.in_palm(points)
    low, high = points.amin(0), points.amax(0)
    torch.testing.assert_close(low[0], torch.tensor(shape.palm_front_m - shape.palm_m[0], dtype=torch.float64))
    assert float(high[0]) == pytest.approx(shape.pad_m[0], abs=1e-3)
    assert 200 < int(palm.sum()) < len(points)
    # on its border, within rounding
    center = torch.tensor([shape.palm_center_m, 0.0, 0.0], dtype=torch.float64)
    scaled = ((points[palm] - center) / torch.tensor(shape.palm_m, dtype=torch.float64)).abs()
    assert float((scaled.amax(-1) - 0.5).abs().max()) < 1e-6


def test_what_a_stopped_belief_keeps_is_summed_up_to_the_end():
    assert total_nll([10.0, 4.0, 1.0], 5) == pytest.approx(10.0 + 4.0 + 1.0 + 3 * 1.0)
    assert total_nll([10.0, 4.0, 1.0], 2) == pytest.approx(15.0)


def parts_of(tool, **changes):
    table = handle_odds(torch.ones(9, 6, 13, dtype=torch.float64))
    return build_handle(HandleSettings(**changes), tool=tool, table=table)


@pytest.mark.sim
def test_without_time_for_an_action_it_grasps_at_once(tool):
    steps = []
    outcome = loop.run(*parts_of(tool, sensors=("camera",), run_budget_s=4.0), seed=1000, on_step=steps.append)
    assert outcome.stopped_by == "budget" and outcome.steps == 0 and len(steps) == 1
    assert outcome.grasp is not None and outcome.believed > 0.2
    assert outcome.total_nll == pytest.approx(21 * outcome.nll[0])
    assert outcome.total_s == pytest.approx(1.0 + 2.1)


def test_sensors_are_told_in_words():
    assert sensors_of("all") == SENSORS and sensors_of("wrench,camera") == ("camera", "wrench")
    for wrong in ("eyes", "camera,", ""):
        with pytest.raises(UsageError, match="camera"):
            sensors_of(wrong)


def test_a_budget_that_the_first_look_and_the_grasp_exceed_is_told():
    assert short_of(HandleSettings(run_budget_s=3.2)) is None
    assert "less than the 3.1 s" in short_of(HandleSettings(run_budget_s=1.0))
    assert "less than the 2.1 s" in short_of(HandleSettings(run_budget_s=1.0, thinking_s=None))


_WRONG = ("--preset nope", "--run-budget-s inf", "--thinking-s -1", "--seed -1", "--sensors eye")


@pytest.mark.parametrize("wrong", _WRONG)
def test_what_cannot_be_leaves_no_folder(wrong, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["run", "handle", *wrong.split(), "--out", "run"]) == BAD_INPUT
    assert list(tmp_path.iterdir()) == []


@pytest.mark.sim
@pytest.mark.slow
def test_the_command_leaves_a_run_that_can_be_drawn_again(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("RUMI_CACHE", str(tmp_path / "cache"))
    out = tmp_path / "run"
    code = main(["run", "handle", "--seed", "1001", "--run-budget-s", "9", "--out", str(out)])
    said = capsys.readouterr().out
    sure = "handle: sure" in said and "not lifted" not in said
    assert code == (DONE if sure else NOT_CONVERGED)
    assert {"result.json", "settings.json", "trace.npz", "figures"} <= {p.name for p in out.iterdir()}
    assert main(["plot", str(out), "--out", str(tmp_path / "again")]) == DONE
