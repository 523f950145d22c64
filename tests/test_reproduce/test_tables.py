"""Tables of made-up runs, cell by cell."""

import pytest

from scripts.reproduce import cells, studies, tables
from scripts.reproduce.experiments import Selection
from scripts.reproduce.intervals import wilson
from scripts.reproduce.reports import of_experiment, so_far


def rows_of(text):
    """Cells of the rows of Markdown tables by their first cell; the heads under "head"."""
    found, before = {}, ""
    for line in text.splitlines():
        if line.startswith("|---"):
            found["head"] = before
        elif line.startswith("|"):
            before = [cell.strip() for cell in line.strip("|").split("|")]
            found.setdefault(before[0], before)
    return found


@pytest.fixture
def runs(made):
    """Rumi and information alone on two mugs with two seeds each."""
    return [
        made("mug-0", "rumi", 0, nll=(30.0, 10.0)),
        made("mug-0", "rumi", 1, nll=(30.0, 25.0, 12.0)),
        made("mug-1", "rumi", 0, nll=(30.0, 28.0, 8.0)),
        made("mug-1", "rumi", 1, nll=(30.0, 18.0, 40.0, 40.0, 40.0)),
        made("mug-0", "info-only", 0, nll=(30.0, 30.0, 30.0, 30.0, 30.0)),
        made("mug-0", "info-only", 1, nll=(30.0, 40.0, 40.0, 40.0, 15.0)),
        made("mug-1", "info-only", 0, nll=(15.0, 30.0, 30.0, 30.0, 30.0)),
        made("mug-1", "info-only", 1, nll=(30.0, 30.0, 30.0, 30.0, 50.0)),
    ]


def test_successes_by_both_counts(runs):
    rows = rows_of(tables.successes(runs))
    low, high = wilson(3, 4)
    assert rows["rumi/default"] == [
        *("rumi/default", "2 · 2 of 2", "1 · 2 of 2", f"3/4 [{low:.2f}, {high:.2f}]"),
        *(cells.rate([True] * 4), "0", "3: 3", "9, 9: 18"),
    ]
    assert rows["info-only/default"][1:3] == ["1 · 1 of 2", "0 · 1 of 2"]
    assert rows["info-only/default"][5:] == ["1", "0: 0", "3, 5: 8"]
    assert "nll <= 20 at any step" in rows["head"]


def test_cumulative_nll_to_the_stop_and_held(runs):
    rows = rows_of(tables.cumulative_nll(runs))
    # 40 and 67: 53.5; 66 and 168: 117. Held to step 4: 40 + 3 * 10, 67 + 2 * 12; 66 + 2 * 8, 168
    assert rows["rumi/default"][1:3] == ["54", "117"]
    assert rows["rumi/default"][3].split()[0] == f"{53.5 + 117:.0f}"
    assert rows["rumi/default"][4].split()[0] == f"{(70 + 91) / 2 + (82 + 168) / 2:.0f}"
    assert rows["rumi/default"][5] == "925, 1447: 2372"
    assert cells.cumulative(runs[0]) == 40 and cells.cumulative(runs[0], held=True) == 70


def test_pairs(runs):
    (row,) = [row for name, row in rows_of(tables.paired(runs)).items() if name == "rumi/default"]
    # of the pairs only mug-0 seed 1 is right in both; rumi alone in two more: p = 2 * 0.25
    assert row[1:9] == ["info-only/default", "mug", "4", "1", "2", "0", "0.5", "0.5"]
    # medians of information alone: 157.5 and 152.5
    assert row[9].split()[0] == f"{(150 + 165) / 2 + (135 + 170) / 2 - 53.5 - 117:+.0f}"
    assert tables.paired([run for run in runs if run.method == "rumi"]) == ""


def test_pairs_are_of_the_same_preset_where_there_is_one(runs, made):
    more = [made("mug-0", name, 0, nll=(30.0,), preset="paper") for name in ("rumi", "slide")]
    lines = [line.split("|")[1:3] for line in tables.paired([*runs, *more]).splitlines()[2:]]
    assert [[cell.strip() for cell in line] for line in lines] == [
        ["rumi/default", "info-only/default"],
        ["rumi/default", "rumi/paper"],
        ["rumi/paper", "slide/paper"],
    ]


def test_correlation_with_the_papers_beside(runs):
    rows = rows_of(studies.correlation(runs))
    assert rows["nll and APC, default (rumi, info-only)"][1].split()[0] == "1.00"
    assert rows["nll and expected nll, default (rumi, info-only)"][1].split()[0] == "-1.00"
    assert rows["nll and APC, the paper"][1:] == ["0.93", "0.82"]
    # 10 to 40 thousandths over 0.2
    (spread,) = [row for name, row in rows.items() if name.startswith("APC over the diagonal")]
    assert spread[1:] == ["5.0 to 20.0 %", "4.0 to 25.0 %"]


def test_seconds_of_a_pass(runs):
    rows = rows_of(studies.seconds(runs[:2]))
    assert rows["p(S), information field"][1:] == ["0.0500 (0.0000)", "0.061 (0.001)"]
    assert rows["cost look-up"][1:] == ["0.1500 (0.0000)", "0.178 (0.002)"]
    assert rows["GP fit"][1:] == ["-", "1.870 (0.066)"]
    assert rows["dynamics"][1] == "-"


def test_experiments_take_the_runs_they_are_about(runs, made):
    other = made("mug-0", "rumi", 0, nll=(30.0,), overrides=("initialise.particles=30",))
    every = [*runs, other, made("mug-0", "rumi", 5, nll=(30.0,)), made("mug-0", "rumi", 0, nll=(9.0,), preset="fast")]
    seeds = Selection(seeds=(0, 1))
    assert {run.preset for run in of_experiment("table5", seeds, every)} == {"default", "fast"}
    assert len(of_experiment("table5", Selection(presets=("default",), seeds=(0, 1)), every)) == 8
    assert len(of_experiment("table5", Selection(methods=("rumi",), tasks=("mug-1",), seeds=(0, 1)), every)) == 2
    particles = of_experiment("fig5", Selection(tasks=("mug-0",), seeds=(0,)), every)
    assert [run.overrides for run in particles] == [("initialise.particles=30",), ()]


def test_work_that_is_not_all_done_is_counted(runs):
    jobs = Selection(tasks=("mug-0",), methods=("rumi",), presets=("default",), seeds=(0, 1)).runs((), ())
    assert so_far(jobs, runs) == ""
    more = [*jobs, *Selection(tasks=("mug-0",), methods=("slide",), presets=("paper",), seeds=(0, 1)).runs((), ())]
    assert so_far(more, runs) == "So far 2 of 4 runs are done.\n"


def test_nothing_gives_no_table():
    for nothing in (tables.successes, tables.paired, tables.failed, studies.correlation, studies.seconds, studies.toy):
        assert nothing([]) == ""
