"""Results are kept once, survive whatever cuts a file, and old ones are read."""

from pathlib import Path

import pytest

from rumi.errors import UsageError
from rumi.runs.jsonlines import append_line
from scripts.reproduce.jobs import Job
from scripts.reproduce.records import Records, key_of, line_of

ROOT = Path(__file__).resolve().parents[2]
RESULT = {"figures": {"cost": 1.5}, "timings": {"wall_s": 0.1}, "curves": {"path_x": [1.0]}}


def toy(seed, method="KMPPI"):
    return Job("toy", "toy", method, "", seed)


def test_a_result_comes_back(tmp_path):
    records = Records(tmp_path / "a.jsonl")
    assert records.done([toy(1), toy(2)]) == []
    records.keep(toy(2), RESULT)
    records.refresh()
    (found,) = records.done([toy(1), toy(2)])
    assert (found.figures, found.timings, found.curves) == tuple(RESULT.values())
    assert found.key == key_of(toy(2)) and found.code == toy(2).code and found.id == toy(2).id
    assert found.column == toy(2).column == "KMPPI"
    assert Records(records.path).done([toy(2)]) == [found]


def test_the_first_of_two_counts(tmp_path):
    records = Records(tmp_path / "a.jsonl")
    records.keep(toy(1), RESULT)
    records.keep(toy(1), RESULT | {"figures": {"cost": 9.0}})
    records.refresh()
    assert [record.figures["cost"] for record in records.every] == [1.5]


def test_lines_of_something_else_are_passed_over(tmp_path):
    path = tmp_path / "a.jsonl"
    append_line(path, {"settings": {"part": "run"}, "figures": {}})
    append_line(path, line_of(toy(1), RESULT) | {"schema": 99})
    Records(path).keep(toy(1), RESULT)
    assert len(Records(path).every) == 1


def test_the_newest_code_is_the_last_lines(tmp_path):
    path = tmp_path / "a.jsonl"
    for code, cost in (("old", 1.0), ("new", 2.0), ("new", 3.0)):
        line = line_of(toy(1), RESULT) | {"code": code, "settings": str(cost), "kind": "run", "figures": {"cost": cost}}
        append_line(path, line)
    records = Records(path)
    assert [record.figures["cost"] for record in records.newest()] == [3.0]
    assert [record.figures["cost"] for record in records.newest("old")] == [1.0]
    # of several codes the last one's line of the same piece prevails, wherever in the file it stands
    assert [record.figures["cost"] for record in records.newest("old", "new")] == [3.0]
    assert [record.figures["cost"] for record in records.newest("new", "old")] == [1.0]
    with pytest.raises(UsageError, match=r"no runs by the code other in .* there are by old, new"):
        records.newest("other")


def test_where_a_mesh_lies_is_not_kept(tmp_path):
    (tmp_path / "cup.obj").write_text("v 0 0 0\n")
    job = Job("run", "mug-0", "rumi", "default", 0, (f"object.mesh={tmp_path / 'cup.obj'}", "planner.rollouts=3"))
    assert job.describe()["overrides"] == ["object.mesh=cup.obj", "planner.rollouts=3"]
    assert str(tmp_path) not in job.column
    assert str(tmp_path) not in str(key_of(job))
