"""What settings of the peg task must be, and which of option and setting counts."""

import json
import math

import pytest

from rumi import exit_codes
from rumi.cli import main
from rumi.errors import UsageError
from rumi.runs.json_settings import dataclass_of
from rumi.tasks.peg.settings import PegSettings

QUICK = ["--particles", "100", "--search-particles", "300", "--point-m", "0.001", "--normal-deg", "2"]
QUICK += ["--most-actions", "1"]


@pytest.mark.parametrize(
    ("flag", "words"),
    [
        ("--lane-m 0", "lane_m above 0"),
        ("--table-m 0.8", "--table-m"),
        ("--particles 10.5", "--particles"),
        ("--sampled maybe", "maybe"),
        ("--action-budget-s nan", "action_budget_s above 0 and finite"),
        ("--action-budget-s None", "--action-budget-s"),
        ("--point-m many", "--point-m"),
        ("--stop luck", "'luck'"),
        ("--seed -1", "seed to be 0 or more"),
    ],
)
def test_settings_that_cannot_be(flag, words, tmp_path, capsys):
    asked = ["run", "peg", "--no-figures", "--out", str(tmp_path / "run"), *flag.split()]
    assert main(asked) == exit_codes.BAD_INPUT
    said = capsys.readouterr().err
    assert words in said and "RUMI_DEBUG" not in said
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"particles": 10.5}, "particles to be of type int, got 10.5"),
        ({"sampled": 1}, "sampled to be of type bool, got 1"),
        ({"action_budget_s": True}, "action_budget_s to be of type float, got True"),
        ({"table_m": [0.8]}, "table_m to have 2 values"),
        ({"stop": "luck"}, "stop to be one of mass, contacts, covariance, entropy, got 'luck'"),
        ({"colour": "blue"}, "There is no setting colour; there are action_budget_s"),
    ],
)
def test_records_that_cannot_be(values, words):
    with pytest.raises(UsageError, match=words):
        dataclass_of(PegSettings, values)


def test_a_folder_that_has_a_run_is_left_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    command = ["run", "peg", "--no-figures", "--seed", "3", *QUICK]
    for _ in range(2):
        main(command)
    main([*command, "--action-budget-s", "12"])
    found = sorted(path.name for path in (tmp_path / "runs").iterdir())
    assert found == ["peg-t10-mass-s3", "peg-t10-mass-s3-2", "peg-t12-mass-s3"]
    records = [json.loads((tmp_path / "runs" / name / "settings.json").read_text()) for name in found]
    assert [record["peg"]["action_budget_s"] for record in records] == [10.0, 10.0, 12]
    assert main([*command, "--out", "runs/peg-t10-mass-s3"]) == exit_codes.BAD_INPUT
    assert "holds a run already" in capsys.readouterr().err


def test_the_tolerance_of_a_hole_counts():
    from rumi import loop
    from rumi.tasks.peg.agent import build_peg

    sharp = {"particles": 200, "search_particles": 600, "point_m": 0.001, "normal_deg": 2.0, "most_actions": 3}
    wide = loop.run(*build_peg(PegSettings(**sharp)), seed=0)
    errors = (wide.hole_error_m, wide.off_m)
    for tolerance in (0.5 * min(errors), 2.0 * max(errors)):
        # one action less and no rule to stop: the tolerance is of what is told of the end
        run = loop.run(*build_peg(PegSettings(**sharp, tolerance_m=tolerance, contacts=50)), seed=0)
        assert run.as_dict()["right"] == (run.hole_error_m < tolerance)
        assert run.in_hole == (run.off_m < tolerance)
    assert math.isclose(PegSettings().tolerance_m, 0.005)
