"""What was measured is kept, and not measured again."""

import json

import torch

from scripts.bench.ledger import Ledger, median_seconds


def test_a_measurement_is_done_once(tmp_path):
    calls = []

    def work():
        calls.append(1)
        return {"error": torch.tensor(0.5), "none": float("inf")}

    path = tmp_path / "deep" / "a.jsonl"
    ledger = Ledger(path)
    assert ledger.measure({"part": "a", "size": (1, 2)}, work)
    assert not ledger.measure({"part": "a", "size": (1, 2)}, work)
    assert not Ledger(path).measure({"size": [1, 2], "part": "a"}, work)
    assert Ledger(path).measure({"part": "b"}, work)
    assert len(calls) == 2
    assert ledger.of("a") == [{"part": "a", "size": [1, 2], "error": 0.5, "none": None}]
    line = json.loads(path.read_text().splitlines()[0])
    assert set(line) == {"settings", "figures", "commit", "machine"}


def test_a_line_that_was_cut_off_is_measured_again(tmp_path):
    path = tmp_path / "a.jsonl"
    Ledger(path).measure({"part": "a"}, dict)
    Ledger(path).measure({"part": "b"}, dict)
    path.write_text(path.read_text()[:-20])
    again = Ledger(path)
    assert [line["settings"]["part"] for line in again.lines()] == ["a"]
    assert again.measure({"part": "b"}, dict)
    assert [line["settings"]["part"] for line in Ledger(path).lines()] == ["a", "b"]


def test_the_median_needs_few_calls():
    calls = []
    assert median_seconds(lambda: calls.append(1), repeats=3) >= 0
    assert len(calls) == 4
    assert median_seconds(lambda: calls.append(1), budget_s=0.0) >= 0
    assert len(calls) == 5
