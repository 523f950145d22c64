"""What settings of the peg task must be, and which of option and setting counts."""

import json
import math

import pytest

from rumi import cli
from rumi.cli import main
from rumi.commands.run_peg import PegOptions, settings_of
from rumi.errors import UsageError
from rumi.tasks.peg.settings import PegSettings

QUICK = ["particles=100", "search_particles=300", "point_m=0.001", "normal_deg=2", "most_actions=3"]


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("low_m=0", "low_m above 0"),
        ("low_m=-0.1", "low_m above 0"),
        ("low_m=0.2", "meets no side"),
        ("lane_m=0", "lane_m above 0"),
        ("lane_m=-1", "lane_m above 0"),
        ("table_m=[0.8]", "table_m as two numbers"),
        ("table_m=0.8", "table_m as two numbers"),
        ("table_m=[0.8, -1]", "table_m above 0"),
        ("clear=2", "clear, a probability"),
        ("hole_m=5", "holes in the block"),
        ("hole_m=-0.01", "hole_m to be 0 or more"),
        ("particles=10.5", "particles to be a whole number"),
        ("doublings=1.5", "doublings to be a whole number"),
        ("doublings=-1", "doublings to be 0 or more"),
        ("sampled=maybe", "sampled to be true or false"),
        ("sampled=1", "sampled to be true or false"),
        ("t_max_s=Infinity", "t_max_s to be a finite number"),
        ("t_max_s=NaN", "t_max_s to be a finite number"),
        ("t_max_s=null", "t_max_s to be a finite number"),
        ("t_max_s=true", "t_max_s to be a finite number"),
        ("point_m=many", "point_m to be a finite number"),
        ("evaluation_s=-1", "evaluation_s to be 0 or more"),
        ("radius_m=0", "radius_m above 0"),
        ("speed_m_s=0", "speed_m_s above 0"),
        ("length_m=-0.2", "length_m above 0"),
        ("tolerance_m=-1", "tolerance_m above 0"),
        ("probability=2", "probability between 0 and 1"),
        ("particles=1", "particles of 100 or more"),
        ("search_particles=0", "search_particles of 300 or more"),
        ("spread_deg=0", "spread_deg above 0"),
        ("stop=luck", "stop to be one of mass, contacts, covariance, entropy"),
    ],
)
def test_settings_that_cannot_be(setting, words, tmp_path, capsys):
    assert main(["run", "peg", "--no-figures", "--out", str(tmp_path / "run"), "--set", setting]) == cli.BAD_INPUT
    said = capsys.readouterr().err
    assert words in said and "RUMI_DEBUG" not in said
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("option", "words"),
    [
        (["--t-max", "nan"], "t_max_s to be a finite"),
        (["--t-max", "inf"], "t_max_s to be a finite"),
        (["--t-max", "-1"], "t_max_s above 0"),
        (["--evaluation", "nan"], "evaluation_s to be a finite"),
        (["--evaluation", "-1"], "evaluation_s to be 0 or more"),
        (["--seed", "-1"], "--seed of 0 or more"),
    ],
)
def test_options_that_cannot_be(option, words, tmp_path, capsys):
    assert main(["run", "peg", "--no-figures", "--out", str(tmp_path / "run"), *option]) == cli.BAD_INPUT
    said = capsys.readouterr().err
    assert words in said and "RUMI_DEBUG" not in said


def test_a_setting_counts_unless_the_option_is_given_as_well():
    found = settings_of(PegOptions(set=("t_max_s=20", "stop=contacts", "evaluation_s=0.5")))
    assert (found.t_max_s, found.stop, found.evaluation_s) == (20, "contacts", 0.5)
    assert settings_of(PegOptions(set=("evaluation_s=null",))).evaluation_s is None
    assert settings_of(PegOptions()) == PegSettings()
    # both, if they agree
    assert settings_of(PegOptions(t_max=20.0, stop="entropy", set=("t_max_s=20", "stop=entropy"))).t_max_s == 20.0
    for options, words in (
        (PegOptions(t_max=10.0, set=("t_max_s=20",)), "one value of t_max_s, got 10.0 by --t-max and 20 by --set"),
        (PegOptions(stop="mass", set=("stop=contacts",)), "one value of stop"),
        (PegOptions(evaluation="real", set=("evaluation_s=1",)), "one value of evaluation_s"),
    ):
        with pytest.raises(UsageError, match=words):
            settings_of(options)


def test_a_folder_that_has_a_run_is_left_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    command = ["run", "peg", "--no-figures", "--seed", "3", "--set", *QUICK]
    for _ in range(2):
        main(command)
    main([*command, "t_max_s=12"])
    found = sorted(path.name for path in (tmp_path / "runs").iterdir())
    assert found == ["peg-t10-mass-s3", "peg-t10-mass-s3-2", "peg-t12-mass-s3"]
    records = [json.loads((tmp_path / "runs" / name / "result.json").read_text()) for name in found]
    assert [record["settings"]["t_max_s"] for record in records] == [10.0, 10.0, 12]
    assert main([*command[: -len(QUICK) - 1], "--out", "runs/peg-t10-mass-s3"]) == cli.BAD_INPUT
    assert "holds a run already" in capsys.readouterr().err


def test_the_tolerance_of_a_hole_counts():
    from rumi.tasks.peg.agent import run_peg

    sharp = {"particles": 200, "search_particles": 600, "point_m": 0.001, "normal_deg": 2.0, "most_actions": 3}
    wide = run_peg(PegSettings(**sharp), 0)
    errors = (wide.hole_error_m, wide.off_m)
    for tolerance in (0.5 * min(errors), 2.0 * max(errors)):
        # one action less and no rule to stop: the tolerance is of what is told of the end
        run = run_peg(PegSettings(**sharp, tolerance_m=tolerance, contacts=50), 0)
        assert run.as_dict()["right"] == (run.hole_error_m < tolerance)
        assert run.in_hole == (run.off_m < tolerance)
    assert math.isclose(PegSettings().tolerance_m, 0.005)
