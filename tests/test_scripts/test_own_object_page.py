"""The page on own objects: its code runs as it is printed."""

from pathlib import Path

import pytest

from scripts.bench.mug_mesh import mug_mesh, write_obj
from sdf.primitives import Mug

for package in ("trimesh", "scipy", "networkx"):
    pytest.importorskip(package)

PAGE = Path(__file__).resolve().parents[2] / "scripts" / "docs" / "how-to" / "own-object.md"


@pytest.mark.sim
@pytest.mark.slow
def test_the_code_of_the_page(tmp_path, capsys):
    shown: dict = {}
    exec(PAGE.read_text().split("```python\n")[1].split("```")[0], shown)
    path = tmp_path / "mug.obj"
    write_obj(mug_mesh(Mug(), 0.006), path)
    assert shown["find"](str(path), steps=1, spacing_m=0.004, collision="hull") is False
    assert capsys.readouterr().out.startswith("none\n")
