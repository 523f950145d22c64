"""Recorded actions give the same readings, and the filter follows them; a quick study from end to end."""

import math

import pytest
import torch

from scripts.bench import pareto
from scripts.bench.situations import STAGES, follow, situation
from sdf import se3
from sdf.grid_sdf import GridSDF
from sensors.semantics import Semantics

pytestmark = [pytest.mark.sim, pytest.mark.usefixtures("at_home")]


def test_a_situation_is_the_same_twice_and_holds_what_was_touched():
    first, again = situation("mug-1", "view"), situation("mug-1", "view")
    assert first.digest == again.digest
    assert len(first.readings) == 1
    touched = situation("mug-1", "touch")
    assert len(touched.readings) == STAGES["mug-1"]["touch"] + 1
    assert any(bool(reading.in_contact.any()) for reading in touched.readings)
    surface = touched.memory.points[touched.memory.of_class(Semantics.SURFACE)]
    assert len(surface) > int(first.memory.of_class(Semantics.SURFACE).sum())
    # in the frame that rides with the object, all surface points are on it at its true pose
    inside = se3.apply(se3.inverse(touched.truth), surface).double()
    assert float(touched.model.exact.distance(inside).abs().max()) < 0.004
    # which is where it was at the start: without noise, what moved is known
    torch.testing.assert_close(touched.truth, first.truth, atol=1e-4, rtol=0)


def test_a_belief_follows_a_situation():
    here = situation("mug-1", "touch")
    table = GridSDF.from_sdf(here.model.exact, 0.003).float()
    followed = follow(here, table, particles=12, seed=3)
    again = follow(here, table, particles=12, seed=3)
    assert followed.belief.attached_T_object.shape == (12, 4, 4)
    torch.testing.assert_close(followed.belief.log_weights, again.belief.log_weights, rtol=0, atol=0)
    off = (followed.belief.attached_T_object[:, :3, 3] - here.truth[:3, 3]).norm(dim=-1)
    assert float(off.min()) < 0.005
    assert followed.first_s > 0
    assert followed.step_s > 0


@pytest.mark.slow
def test_a_quick_study_from_end_to_end(tmp_path):
    torch.set_num_threads(1)
    pareto.run(quick=True, out=tmp_path)
    store = pareto.Store(tmp_path / "pareto.jsonl")
    parts = {line["settings"]["part"] for line in store.lines}
    assert parts >= {"belief", "field", "run", "chains", "box-belief", "field-time"}
    assert (tmp_path / "pareto.png").stat().st_size > 10_000
    numbers = [value for line in store.lines for value in line["figures"].values() if isinstance(value, float)]
    assert all(map(math.isfinite, numbers))
    before = (tmp_path / "pareto.jsonl").read_bytes()
    pareto.run(quick=True, out=tmp_path)  # nothing is measured twice
    assert (tmp_path / "pareto.jsonl").read_bytes() == before
