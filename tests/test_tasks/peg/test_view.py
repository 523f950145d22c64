"""What a viewer shows of a peg run."""

from dataclasses import asdict, replace

import pytest
import torch

from rumi import loop
from rumi.information.contact_gain import ContactKind
from rumi.runs.folder import RunRecorder, load_run
from rumi.tasks.peg.agent import build_peg
from rumi.tasks.peg.entry import PEG
from rumi.tasks.peg.settings import PegSettings
from rumi.tasks.peg.view import PegView

QUICK = PegSettings(particles=200, search_particles=600, point_m=0.001, normal_deg=2.0)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "run"
    with RunRecorder(folder, {"task": "peg", "seed": 1, "peg": asdict(QUICK)}) as recorder:
        recorder.finish(loop.run(*build_peg(QUICK), seed=1, on_step=recorder))
    return load_run(folder)


def decided(run):
    return [number for number, record in enumerate(run.steps) if record.thought is not None]


def test_a_decision_shows_the_rejected_motions_and_says_why(run):
    view = PegView(QUICK)
    assert decided(run)
    for number in decided(run):
        found, selection = view.decision(run.steps[: number + 1]), run.steps[number].thought.selection
        assert len(found.scene["samples"].lines) == selection.evaluated - 1
        assert found.curves["gain/chosen"] == selection.gain == max(row.gain for row in selection.history)
        assert found.curves.get("gain/best_rejected", 0.0) <= selection.gain
        for word in ("gain", "where", "odds", "risk", "time", "holes"):
            assert f"**{word}**" in found.words


def test_a_record_of_before_knows_the_gains_alone(run):
    number = max(decided(run), key=lambda at: run.steps[at].thought.selection.evaluated)
    record = run.steps[number]
    selection = record.thought.selection
    assert selection.evaluated > 1
    history = tuple(row._replace(action=None) for row in selection.history)
    old = replace(record, thought=record.thought._replace(selection=replace(selection, history=history)))
    found = PegView(QUICK).decision([*run.steps[:number], old])
    assert not found.scene["samples"].lines and "of the rejected" in found.words


def test_lanes_are_shown_as_what_nothing_was_weighed_for(run):
    view = PegView(QUICK)
    assert run.steps[1].thought is None
    assert "lane of the search" in view.decision(run.steps[:2]).words
    first = view.step(run.steps[:1], None).scene
    assert len(first["places"].points) == 500 and not first["tool/path"].lines
    after = view.step(run.steps, PEG.pose(run))
    assert not len(after.scene["places"].points) and set(after.curves) == {"time/motion", "right/holes", "nll/true"}


def test_contacts_are_those_that_were_felt(run):
    shown = PegView(QUICK).step(run.steps, None).scene
    kinds = [record.felt.kind for record in run.steps[1:]]
    names = {"contacts": ContactKind.TOUCH, "contacts/tops": ContactKind.TOP, "contacts/missed": ContactKind.NOTHING}
    for name, kind in names.items():
        assert len(shown[name].points) == kinds.count(kind)
    lengths = shown["contacts/normals"].vectors.norm(dim=-1)
    torch.testing.assert_close(lengths, torch.full_like(lengths, 0.03), atol=1e-6, rtol=0)
    assert len(shown["holes"].lines) == 2


def test_a_replay_decides_nothing(run):
    number = decided(run)[-1]
    taken = [*run.steps[:number], replace(run.steps[number], thought=None)]
    assert PegView(QUICK).decision(taken) is None
