"""Seconds of each step, which are for people: whatever their file holds, a run is read; and where figures may go."""

import pytest

import rumi
from rumi import exit_codes
from rumi.cli import main
from rumi.errors import UsageError
from rumi.runs.folder import RunRecorder, load_run
from tests.fixtures.made_up_run import make_up


@pytest.fixture(scope="module")
def run():
    return make_up(6, particles=20)


def record(folder, run):
    with RunRecorder(folder, {"task": "mug-0", "seed": 3}, run.geometry) as recorder:
        for step in run.steps:
            recorder(step)
        recorder.finish(run.result)
    return folder


@pytest.mark.parametrize(
    "line", ["[1, 2]", "3", "{}", '{"step": [], "timings_s": {}}', '{"step": 0, "timings_s": 1}', "{"]
)
def test_a_line_of_steps_without_seconds_is_passed_over(tmp_path, run, line):
    folder = record(tmp_path / "run", run)
    lines = (folder / "steps.jsonl").read_text().splitlines()
    (folder / "steps.jsonl").write_text("\n".join([line, *lines[1:]]) + "\n")
    steps = load_run(folder).steps
    assert steps[0].timings_s == {} and [step.timings_s for step in steps[1:]] == [s.timings_s for s in run.steps[1:]]


def test_steps_that_are_no_text_do_not_damage_the_trace(tmp_path, run):
    folder = record(tmp_path / "run", run)
    (folder / "steps.jsonl").write_bytes(b"\xff\xfe\n")
    assert len(load_run(folder).steps) == len(run.steps)


def test_figures_are_refused_a_folder_that_is_a_file(tmp_path, run, capsys):
    folder = record(tmp_path / "run", run)
    (tmp_path / "file").write_text("in the way")
    assert main(["plot", str(folder), "--out", str(tmp_path / "file")]) == exit_codes.BAD_INPUT
    assert f"Cannot write to the folder {tmp_path / 'file'}" in capsys.readouterr().err
    with pytest.raises(UsageError, match="Cannot write to the folder"):
        rumi.plot(folder, tmp_path / "file")
