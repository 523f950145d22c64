"""The example that learns a contact sensor through the filter, in small."""

import json
from pathlib import Path

import pytest
import torch

pytest.importorskip("matplotlib")

from scripts import learn_contact_sensor as example
from scripts.train_through_filter import log_evidence, record, train
from sensors.touch.contact_model import ContactModel

ROOT = Path(__file__).resolve().parents[2]


def test_a_little_training_explains_what_was_held_out_better():
    random, true = torch.Generator().manual_seed(0), ContactModel(*example.TRUE)
    data, held = record(true, 16, 8, random), record(true, 16, 8, random)
    sensor = ContactModel(*example.START, trainable=True)
    before = example.held_out(sensor, held)
    train(sensor, *data, particles=40, steps=10)
    assert example.held_out(sensor, held) < before - 0.2
    assert all(value > 0 for value in example.physical(sensor))


def test_the_curvature_is_that_of_the_log_evidence_without_resampling():
    random, true = torch.Generator().manual_seed(1), ContactModel(*example.TRUE)
    data, sensor = record(true, 4, 2, random), ContactModel(*example.TRUE, trainable=True)
    at, shift = example.raw(sensor), torch.tensor([0.0, 0.01, 0.0])
    slope = example.gradient(sensor, at, data, 50, draws=1)
    sums = []
    for sign in (1.0, -1.0):
        example.put(sensor, at + sign * shift)
        sums.append(-float(log_evidence(sensor, *data, 50, torch.Generator().manual_seed(10_000)).sum().detach()))
    assert (sums[0] - sums[1]) / 0.02 == pytest.approx(float(slope[1]), rel=0.05, abs=0.01)


def test_the_whole_example_in_small(tmp_path):
    options = example.Options(episodes=5, touches=3, particles=20, steps=2, seeds=(1000, 1), out=tmp_path)
    lines = example.main(options)
    written = (tmp_path / "contact_sensor.jsonl").read_text().splitlines()
    assert json.loads(written[0]) == lines[0] and len(written) == 2
    assert example.main(options) == lines, "what is there is not done again"
    assert set(lines[0]["found"]) == set(example.NAMES) and (tmp_path / "contact_sensor.png").stat().st_size > 1000


def test_it_takes_no_more_than_forty_lines():
    assert len((ROOT / "scripts" / "train_through_filter.py").read_text().splitlines()) <= 40
