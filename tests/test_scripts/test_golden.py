"""Golden digests: what they are keyed by, and how runs are compared. The runs themselves are no test: minutes each."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest
import torch

pytest.importorskip("mujoco")
pytest.importorskip("h5py")

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def golden():
    spec = importlib.util.spec_from_file_location("golden", ROOT / "scripts" / "golden.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


RECORD = {"steps": [[None, "a"], ["1", "b"], ["2", "c"]], "result": {"right": True, "apc": 0.5}}


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (RECORD, None),
        (RECORD | {"steps": [[None, "a"], ["1", "x"], ["3", "y"]]}, "the belief of step 1"),
        (RECORD | {"steps": [[None, "a"], ["1", "b"], ["3", "y"]]}, "the action of step 2"),
        (RECORD | {"steps": RECORD["steps"][:2]}, "the number of steps: 3 on record, 2 now"),
        (RECORD | {"result": {"right": True, "apc": 0.25}}, "the result's apc: 0.5 on record, 0.25 now"),
        (RECORD | {"result": {"right": True}}, "the result's apc: 0.5 on record, None now"),
        (RECORD | {"result": RECORD["result"] | {"new": None}}, "the result's new: None on record, None now"),
    ],
)
def test_the_first_difference_is_named(golden, found, words):
    assert golden.difference(RECORD, found) == words


def test_a_digest_is_of_bits(golden):
    values = torch.tensor([0.0, 1.0])
    assert golden.digest([values]) == golden.digest([values.clone()])
    others = ([-values], [values.double()], [values[:1]], [values, values], [torch.nextafter(values, values + 1)])
    assert len({golden.digest(other) for other in ([values], *others)}) == 1 + len(others)


def test_the_key_tells_processors_apart(golden, monkeypatch):
    here = golden.processor()
    assert here == golden.processor()
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "OTHER")
    assert golden.processor() not in (here, "") and "torch" in golden.processor()


def test_what_is_not_known_ends_with_2(golden, monkeypatch, tmp_path):
    monkeypatch.setattr(golden, "DIGESTS", tmp_path / "digests.json")
    with pytest.raises(golden.UsageError, match="There is no golden run 'nosuch'"):
        golden.main(golden.Check(("nosuch",)))
    with pytest.raises(golden.UsageError, match="first record them from a commit that is trusted"):
        golden.main(golden.Check(("mug-0",)))
    (tmp_path / "digests.json").write_text(json.dumps({golden.processor(): {"peg": RECORD}}))
    with pytest.raises(golden.UsageError, match="There are no digests of mug-0 with"):
        golden.main(golden.Check(("peg", "mug-0")))


def test_a_run_is_recorded_and_checked(golden, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(golden, "DIGESTS", tmp_path / "digests.json")
    monkeypatch.setattr(golden.torch, "set_num_threads", lambda count: None)
    belief = torch.arange(3.0)

    def run(trace):
        trace.add([belief], None)
        return {"sum": float(belief.sum())}

    monkeypatch.setattr(golden, "RUNS", {"one": run})
    assert golden.main(golden.Renew()) == 0
    assert golden.main(golden.Check()) == 0
    belief += 1.0
    assert golden.main(golden.Check(("one",))) == 1
    assert "DIFFERS in the belief of step 0" in capsys.readouterr().out
