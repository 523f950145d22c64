"""Table I of the time-allocation paper and what goes with it, from records."""

from dataclasses import replace

import pytest

from rumi.errors import UsageError
from scripts.reproduce import allocation
from scripts.reproduce.experiments import EXPERIMENTS, Selection, work_of
from scripts.reproduce.peg import carry_out, settings_of
from scripts.reproduce.records import Record, Records

QUICK = ("t_max_s=10", "particles=150", "search_particles=400", "point_m=0.001", "normal_deg=2")


def record(seed, overrides, **figures):
    whole = {
        "in_hole": True, "right": True, "off_mm": 2.0, "hole_error_mm": 3.0, "middle_error_mm": 2.0, "touches": 18,
        "probability": 0.96, "total_s": 100.0, "search_s": 30.0, "thinking_s": 20.0, "evaluated": 40, "actions": 10,
        "stopped_by": "sure", "doublings": 5, "evaluation_s": 0.004,
    }  # fmt: skip
    curves = {"contact_s": [30.0 + seed, 40.0, 50.0, 60.0], "probability": [0.1, 0.9]}
    return Record("peg", "peg", "allocation", "", seed, tuple(overrides), whole | figures, {"wall_s": 1.0}, curves)


def test_a_run_is_kept_and_found_again(tmp_path):
    job = replace(work_of(["allocation-table1"], Selection(seeds=(3,)))[0], overrides=QUICK)
    records = Records(tmp_path / "peg.jsonl")
    records.keep(job, job.carry_out(tmp_path))
    records.refresh()
    (found,) = records.done([job])
    assert found.figures == carry_out(QUICK, 3)["figures"]
    assert found.curves["contact_s"][0] == found.figures["search_s"]
    assert len(found.curves["contact_s"]) == found.figures["touches"]
    assert found.timings["wall_s"] > 0


def test_the_settings_of_a_run():
    found = settings_of(["t_max_s=20", "stop=contacts", "table_m=[0.6, 0.4]", "evaluation_s=null"])
    assert (found.action_budget_s, found.stop, found.table_m, found.evaluation_s) == (20, "contacts", (0.6, 0.4), None)
    with pytest.raises(UsageError, match=r"no setting '?time"):
        settings_of(["time=3"])


def test_experiments_share_what_they_have_in_common():
    selection = Selection(seeds=(0, 1))
    sizes = {name: len(work_of([name], selection)) for name in EXPERIMENTS if name.startswith("allocation")}
    assert sizes == {"allocation-table1": 4, "allocation-accuracy": 8, "allocation-time": 60}
    every = work_of(sizes, selection)
    assert len({job.id for job in every}) == 72 - 2 - 2  # 10 s with either stop is in two of them
    for job in every:
        assert (settings_of(job.overrides).evaluation_s is None) == (job.kind == "peg-real")


def test_the_least_is_marked(tmp_path):
    runs = [
        record(s, (f"t_max_s={t}", *machine), total_s=total + s)
        for machine, row in (((), (90, 50, 70)), (("evaluation_s=0.003",), (60, 55, 40)))
        for t, total in zip((3, 7, 20), row, strict=True)
        for s in range(4)
    ]
    lines = allocation.totals(runs).splitlines()[2:]
    assert [("**" in line) for line in lines] == [False, True, False, False, False, True]
    assert lines[1].startswith("| 1 | 7 | 4 | **52 [") and lines[5].startswith("| 0.003 | 20 | 4 | **42 [")
    assert "| 4.0 | 0.50 | 4/4 | 0/4 [" in lines[0]  # candidates and doublings a decision, sure, unsure
    (path,) = allocation.draw_totals(runs, tmp_path / "time.png")
    assert path.stat().st_size > 10_000
    # what never became sure did not take so little time to it
    unsure = [record(s, ("t_max_s=3",), total_s=9.0, stopped_by="steps") for s in range(4)]
    assert "**" in allocation.totals([*unsure, *runs[4:8]]) and "**" not in allocation.totals(unsure)
    last = allocation.totals(unsure).splitlines()[-1]
    assert "| 0/4 | 4/4 [" in last
    assert allocation.draw_totals(unsure, tmp_path / "unsure.png")
    real = [record(s, ("t_max_s=7", "evaluation_s=null")) for s in range(4)]
    assert allocation.totals([*runs, *real]).splitlines()[-1].startswith("| measured, 0.004 | 7 | 4 | **100 [")
    assert allocation.draw_totals([], tmp_path / "none.png") == []
