"""The table of what was skipped."""

import pytest

from rumi.cli import main
from rumi.commands.explain import explain
from sdf.skipped_work import Account, Work


def test_says_how_much_was_done_of_how_much_and_what_that_saved() -> None:
    kept = Account()
    kept.add("contact_checks", Work(2e3, 2e5, 0.5))
    kept.add("workspace_points", Work(1650, 6600, 0.1))
    kept.add("normals", Work(0, 6600, 0.0))
    kept.add("something_else", Work(1, 2, 0.0))
    head, points, normals, checks, other, foot = explain(kept).splitlines()
    assert head.split() == ["skipped", "done", "of", "took", "saved"]
    assert points.split()[:7] == ["75", "%", "1650", "6600", "0.10", "s", "0.30"]
    assert normals.split()[:6] == ["100.00", "%", "0", "6600", "-", "-"]
    assert checks.split()[:8] == ["99", "%", "2000", "200", "k", "0.50", "s", "49.50"]
    assert other.endswith("something_else")
    assert foot.startswith("saved:")


@pytest.mark.sim
def test_a_run_explains_itself(tmp_path: object, capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["run", "mug-0", "--steps", "2", "--out", f"{tmp_path}/run", "--no-figures", "--explain", "--glossary"])
    said = capsys.readouterr().out
    assert code in (0, 1)
    assert all(f"\n  {word} " in said for word in ("nll", "expects", "apc", "ess", "agree", "r"))
    assert "look at" not in said, "there are no figures"
    works = (
        "places whose worth was worked out",
        "small steps of a push",
        "actions that were planned anew",
        "points that were weighed anew",
        "distances of a point to a pose",
    )
    for words in works:
        assert words in said
