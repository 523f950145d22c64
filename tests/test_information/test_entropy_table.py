"""The script that tells estimates' bias."""

import importlib.util
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "entropy_table.py"


def test_the_table_has_every_estimate(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    spec = importlib.util.spec_from_file_location(SCRIPT.stem, SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[SCRIPT.stem] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    monkeypatch.setattr(sys, "argv", ["entropy_table.py", "--sets", "20", "--count", "50"])
    module.main()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "50 states, 5 neighbours, 20 sets"
    cells = {line.split("|")[1].strip(): [c.split()[0] for c in line.split("|")[2:-1]] for line in lines[4:]}
    assert set(cells) == {"spatial", "spatial, without itself", "spatial, geometric mean", "kernel", "neighbour"}
    # the estimate from neighbours' distances is nearly right on a line
    assert abs(float(cells["neighbour"][0])) < 0.1
    # and boxes without the state itself are wider
    assert all(float(a) < float(b) for a, b in zip(cells["spatial"], cells["spatial, without itself"], strict=True))
