"""The wheel: it holds the four packages, their types and the licence, and nothing else."""

import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("rumi", "kmppi", "sdf", "sensors")


@pytest.mark.slow
def test_the_wheel_holds_what_it_needs_and_runs_elsewhere(tmp_path):
    source = tmp_path / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    build = "import sys; from setuptools.build_meta import build_wheel; build_wheel(sys.argv[1])"
    subprocess.run([sys.executable, "-c", build, str(tmp_path)], cwd=source, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        archive.extractall(tmp_path / "site")
    expected = {str(path.relative_to(source)) for name in PACKAGES for path in (source / name).rglob("*.py")}
    about = {name for name in names if ".dist-info/" in name}
    assert names - about == expected | {f"{name}/py.typed" for name in PACKAGES}
    assert any(name.endswith("licenses/LICENSE") for name in about)
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path / 'site')!r});"
        "import rumi, sdf; from rumi.cli import main; print(rumi.__file__); sys.exit(main(['tasks']))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert str(tmp_path) in done.stdout and "mug-0" in done.stdout


def test_the_versions_agree():
    import rumi

    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert rumi.__version__ == version
    assert f"\nversion: {version}\n" in (ROOT / "scripts/docs/CITATION.cff").read_text()
