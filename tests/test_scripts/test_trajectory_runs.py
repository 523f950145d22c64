"""The tables of closed loops on drawn scenes."""

from scripts import trajectory_runs
from scripts.trajectory_runs import Options, settings_of, tables


def step(**changes):
    own = {"contacts": 1, "touched": True, "mm": 1.0, "deg": 1.0, "p": 0.97, "level": 0.5, "expected": 2.0, "nll": 3.0}
    return own | {"cpu_s": 0.1} | changes


def test_the_tables_tell_right_from_sure_and_wrong():
    lines = [
        {
            "part": "mug",
            "motion": "trajectory",
            "set": [],
            "stopped_by": "sure",
            "steps": [step(contacts=0), step(p=0.5), step()],
        },
        {
            "part": "mug",
            "motion": "trajectory",
            "set": [],
            "stopped_by": "sure",
            "steps": [step(contacts=0), step(mm=9.0)],
        },
        {
            "part": "mug",
            "motion": "corrected",
            "set": [],
            "stopped_by": "steps",
            "steps": [step(contacts=0), step(mm=9.0, level=1.0)],
        },
    ]
    said = tables(lines)
    assert "| trajectory | P(right) >= .95 | 2 | 1 | 1 | 0 | 0.970 | 1.5 |" in said
    assert "| trajectory | P(right) >= .98 | 2 | 1 | 0 | 2 | nan |" in said
    assert "| corrected | as it is | 1 | 0 | 0 | 1 |" in said
    assert "| corrected | 1 | 0.00 | 0.00 | 0.00 | 0.00 |" in said
    assert "| 0.480 (" in said  # 0.5 is right in one of one, 0.97 in one of two: (0.5 + 0.94) / 3


def test_settings_of_a_run():
    options = Options(set=("filter.trajectories.across=0.4", "filter.trajectories.rounds=1"))
    chosen = settings_of(options, "trajectory", 7)
    assert (chosen.filter.trajectories.across, chosen.filter.trajectories.rounds, chosen.seed) == (0.4, 1, 7)
    assert chosen.stop.rule == "compared" and not chosen.simulator.measures_motion
    assert settings_of(options, "measured", 7).simulator.measures_motion
    assert trajectory_runs.RESULTS.name == "trajectories.jsonl"
