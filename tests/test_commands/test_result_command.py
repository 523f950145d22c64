"""The command `rumi result`: what a run ended with, and what was odd about it."""

from dataclasses import replace

from rumi.belief.remarks import Remark
from rumi.cli import main
from rumi.exit_codes import DONE
from rumi.runs.folder import RunRecorder
from tests.fixtures.made_up_run import make_up


def test_what_was_odd_is_told_with_the_answer(tmp_path, capsys):
    made = make_up(3, particles=20)
    remark = Remark("lost: knocked", 2, "no pose that is believed fits since about action 1")
    with RunRecorder(tmp_path / "run", {"task": "mug-0", "seed": 3}, made.geometry) as recorder:
        for step in made.steps:
            recorder(step)
        recorder.finish(replace(made.result, remarks=(remark,)))
    assert main(["result", str(tmp_path / "run")]) == DONE
    told = " ".join(capsys.readouterr().out.split())
    assert "odd lost: knocked at action 2: no pose that is believed fits since about action 1" in told
