"""Faults of the peg task: what is reported is changed as each says, and what cannot be is refused."""

from dataclasses import replace

import pytest
import torch

from rumi import exit_codes
from rumi.cli import main
from rumi.information.contact_gain import ContactKind
from rumi.sim.faults import parse_fault
from rumi.tasks.peg.cell import TimedPath
from rumi.tasks.peg.entry import PEG, PegRunSettings
from rumi.tasks.peg.settings import PegSettings
from rumi.tasks.peg.simulated import PegTask


def begun(*texts: str) -> tuple[PegTask, torch.Tensor]:
    task = PegTask(PegSettings(), [parse_fault(text, steps=80, seed=3) for text in texts])
    return task, task.reset(0).reading.tip


def along(tip: torch.Tensor, task: PegTask) -> TimedPath:
    ahead = tip + torch.tensor([0.02, 0.0, 0.0], dtype=torch.float64)
    return TimedPath(torch.stack((tip, ahead)), task.cell.clock())


def test_a_knock_moves_the_block_once():
    task, tip = begun("knock:25@2")
    before = task.cell.truth.clone()
    felt = task.step(along(tip, task)).reading
    assert torch.equal(task.cell.truth, before)
    felt = task.step(along(felt.tip, task)).reading
    moved = task.cell.truth - before
    assert float(moved[:2].norm()) == pytest.approx(0.025, abs=1e-6)
    assert abs(float(moved[2])) <= 25.0 * torch.pi / 180.0
    task.step(along(felt.tip, task))
    assert torch.equal(task.cell.truth - before, moved)


def test_a_ball_that_is_off_goes_beside_and_reports_that_it_did_not():
    (plain, tip), (task, _) = begun(), begun("hand:6@1")
    usual, felt = plain.step(along(tip, plain)).reading, task.step(along(tip, task)).reading
    torch.testing.assert_close(felt.tip, usual.tip)
    assert float((task.cell.tip - felt.tip).norm()) == pytest.approx(0.006, abs=1e-6)
    again = task.step(along(felt.tip, task)).reading  # and goes on from there
    torch.testing.assert_close(again.tip, felt.tip + torch.tensor([0.02, 0.0, 0.0], dtype=torch.float64))


def test_a_false_contact_stops_the_ball_where_nothing_is():
    task, tip = begun("false-contact:1@1")
    felt = task.step(along(tip, task)).reading
    assert felt.kind == ContactKind.TOUCH and 0.0 <= float((felt.tip - tip).norm()) < 0.02
    assert float(felt.normal.norm()) == pytest.approx(1.0)
    assert float((felt.point - felt.tip[:2]).norm()) == pytest.approx(task.cell.radius)


def test_settings_keep_their_faults_and_others_are_refused(capsys):
    own = PegRunSettings(seed=2, fault=("knock:20@4", "hand:5@1"))
    assert PEG.from_dict(PEG.as_dict(own)) == own and PEG.from_dict(PEG.as_dict(replace(own, fault=()))).fault == ()
    kinds = "one of knock, hand, false-contact"
    for wrong, said in (("absent", kinds), ("gremlin", kinds), ("knock@81", "up to 80")):
        assert main(["run", "peg", "--fault", wrong]) == exit_codes.BAD_INPUT
        assert said in capsys.readouterr().err
