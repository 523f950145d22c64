import copy
import json

import pytest
import torch

from rumi.bench import history
from rumi.bench.machine import environment
from rumi.bench.measure import carry_out
from rumi.errors import UsageError


@pytest.fixture(scope="module")
def machine():
    return environment(torch.device("cpu"))


@pytest.fixture
def run(made_up, clock, machine):
    """A recorded run of one made-up case, in which the variant `numba` takes as long as asked."""

    def record(quick=0.01, *, name="some", **more):
        result = carry_out(name, made_up(quick, **more), budget_s=1.0, clock=clock)
        return history.record([result], machine, stamp="2026-01-02T03:04:05+00:00", quick=True)

    return record


def test_lines_come_back_as_they_were(run, tmp_path):
    path = tmp_path / "deep" / "bench.jsonl"
    history.check_writable(path)
    assert not path.exists()
    runs = [run(0.01), run(0.02)]
    for one in runs:
        history.write(path, one)
    assert len(path.read_text().splitlines()) == 2
    assert history.read(path) == runs
    # killed while it wrote
    path.write_text(path.read_text() + '{"schema": 1, "ca')
    assert len(history.read(path)) == 2


def test_json_is_written_in_one_go(run, tmp_path):
    path = tmp_path / "bench.json"
    path.write_text("old")
    history.check_writable(path)
    assert path.read_text() == "old"
    once = run()
    history.write(path, once)
    assert history.read(path) == [once]
    assert [entry.name for entry in tmp_path.iterdir()] == ["bench.json"]


def test_a_variant_that_became_slower_is_flagged(run):
    before = run(0.010)
    for quick, worse in ((0.0119, False), (0.0121, True), (0.005, False)):
        changes, remarks = history.compare(run(quick), [before])
        assert not remarks
        # rumi's own alone, against the peer
        assert [(c.variant, c.baseline, c.worse) for c in changes] == [
            ("torch", "peer", False),
            ("numba", "peer", worse),
        ]
    assert "some, numba: 8.26x as quick as peer, before 10x (+21 % time)" in [
        str(change) for change in history.compare(run(0.0121), [before])[0]
    ]


def test_ratios_are_compared_not_times(run):
    """A machine half as quick does everything half as quickly."""
    before, slower = run(0.01), copy.deepcopy(run(0.01))
    for row in slower["cases"][0]["variants"]:
        row["least_s"] *= 2.0
    assert not any(change.worse for change in history.compare(slower, [before])[0])


def test_without_the_peers_the_naive_way_or_the_plain_version_is_the_measure(run):
    without = copy.deepcopy(run(0.013))
    case = without["cases"][0]
    case["variants"] = [row for row in case["variants"] if row["name"] != "peer"]
    case["baseline"] = "torch"
    changes, _ = history.compare(without, [run(0.01)])
    assert {(c.variant, c.baseline, c.worse) for c in changes} == {("torch", "naive", False), ("numba", "naive", True)}
    case["variants"] = [row for row in case["variants"] if row["by"] == "rumi"]
    changes, _ = history.compare(without, [run(0.01)])
    assert [(c.variant, c.baseline, c.worse) for c in changes] == [("numba", "torch", True)]


def test_the_newest_run_that_has_the_case_counts(run):
    other = run(name="other")
    changes, remarks = history.compare(run(0.011), [run(0.001), run(0.01), other])
    assert not any(change.worse for change in changes) and not remarks
    changes, remarks = history.compare(run(), [other])
    assert not changes and remarks == ["some: not there before"]


def test_threads_and_sizes_are_minded(run):
    two, now = copy.deepcopy(run(0.001)), run(0.01)
    two["machine"]["threads"] = now["machine"]["threads"] + 1
    # an older run at as many threads goes before a newer one at another number
    assert not any(change.worse for change in history.compare(now, [run(0.01), two])[0])
    changes, remarks = history.compare(now, [two])
    assert any(change.worse for change in changes) and "threads before" in remarks[0]
    changes, remarks = history.compare(now, [run(0.001, title="larger")])
    assert not changes and remarks == ["some: other work before (larger)"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "holds no results"),
        ("{}\n", "line 1: no results of `rumi bench`"),
        ("not json\n[1]\n", "line 1"),
        ('{"schema": 99, "cases": []}\n', "newer rumi"),
    ],
)
def test_what_is_no_result_is_refused(content, message, tmp_path):
    path = tmp_path / "bench.jsonl"
    path.write_text(content)
    with pytest.raises(UsageError, match=message):
        history.read(path)


def test_a_file_that_is_no_text_is_named(tmp_path):
    path = tmp_path / "bench.csv"
    path.write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(UsageError, match=r"bench\.csv.*no text"):
        history.read(path)


def test_a_missing_file_says_how_to_make_one(tmp_path):
    with pytest.raises(UsageError, match="rumi bench --json"):
        history.read(tmp_path / "none.jsonl")


def test_records_are_plain_json(run):
    once = run()
    assert json.loads(json.dumps(once, allow_nan=False)) == once
