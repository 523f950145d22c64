from pathlib import Path

import sdf


def test_sdf_is_this_projects_and_not_another_distribution():
    root = Path(__file__).resolve().parents[2]
    assert Path(sdf.__file__).resolve() == root / "sdf" / "__init__.py"
