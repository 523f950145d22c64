"""The table of localisations, on touches of its own."""

import importlib.util
import sys
from pathlib import Path

import pytest
import torch

from sdf.mesh.triangles import Triangles
from sdf.surface import sample_triangles

pytest.importorskip("trimesh")
pytest.importorskip("scipy")

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "localize_table.py"


@pytest.fixture
def table(tmp_path, monkeypatch):
    """The script, with a set of touches of a wedge for its data."""
    spec = importlib.util.spec_from_file_location("localize_table", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "localize_table", module)
    spec.loader.exec_module(module)
    folder = tmp_path / "icub_touch"
    folder.mkdir()
    corners = torch.tensor([[0.0, 0.0, 0.0], [0.15, 0.0, 0.0], [0.02, 0.1, 0.0], [0.03, 0.02, 0.07]]).double()
    faces = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]
    rows = ["OFF", "4 4 0", *(" ".join(map(str, x)) for x in corners.tolist())]
    (folder / "wedge.off").write_text("\n".join([*rows, *("3 " + " ".join(map(str, f)) for f in faces)]) + "\n")
    triangles = Triangles(corners[torch.tensor(faces)])
    points, _ = sample_triangles(triangles, 30, generator=torch.Generator().manual_seed(0))
    rows = [" ".join(f"{x:.6f}" for x in row) for row in points.tolist()]
    (folder / "measWedge.off").write_text("\n".join(["OFF", "30.0 0.0 0.0", *rows]) + "\n")
    monkeypatch.setenv("RUMI_DATA", str(tmp_path))
    monkeypatch.setattr(module, "SETS", {"Wedge": ("wedge.off", 0.001)})
    before = torch.get_num_threads()
    yield module
    torch.set_num_threads(before)


def test_seeds_are_kept_and_shown(table, tmp_path, capsys):
    out = tmp_path / "out.jsonl"
    table.run(table.Run(seeds="1000-1001", sets=("Wedge",), out=out))
    lines = out.read_text()
    assert len(lines.splitlines()) == 2
    table.run(table.Run(seeds="1000,1001", sets=("Wedge",), out=out))
    assert out.read_text() == lines
    table.show(table.Show(out=out))
    assert "| Wedge | 0.001 |" in (shown := capsys.readouterr().out) and "2/2" in shown


def test_without_the_data(table, monkeypatch):
    monkeypatch.delenv("RUMI_DATA")
    with pytest.raises(SystemExit, match="RUMI_DATA"):
        table.run(table.Run())
