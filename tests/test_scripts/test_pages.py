"""The pages: paths that they and the code name are there, the commands that they show parse, their Python compiles."""

import ast
import importlib
import re
import shlex
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import tyro

import rumi.cli
from rumi.errors import UsageError

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "scripts" / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
SHOWN = [ROOT / "README.md", *sorted((DOCS / "tutorial").glob("*.md")), *sorted((DOCS / "how-to").glob("*.md"))]
LIBRARIES = ("kmppi", "rumi", "scripts", "sdf", "sensors")


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def blocks(page: Path) -> Iterator[tuple[str, str]]:
    """Code of a page: (language, text), indented blocks without a language."""
    text = re.sub(r"(?ms)^```(\w*)\n(.*?)^```\n", "", page.read_text())
    yield from re.findall(r"(?ms)^```(\w*)\n(.*?)^```\n", page.read_text())
    yield from (("", block) for block in re.findall(r"(?m)(?:^ {4}.*\n)+", text))


COMMANDS = sorted(
    {
        (name(page), line.strip())
        for page in SHOWN
        for language, text in blocks(page)
        if language in ("", "bash", "sh")
        for line in text.splitlines()
        if re.match(r"\s*(\.venv/bin/)?(rumi|python -m|python|scripts/\w+)\s", line)
    }
)


class ParsedError(Exception):
    """A command line was read."""


@pytest.fixture
def parse_alone(monkeypatch, tmp_path):
    """A command ends when its options are read, in a folder that has no run."""
    read = tyro.cli

    def cli(*given, **named):
        found = read(*given, **named)
        if named.get("return_unknown_args"):
            return found
        raise ParsedError

    monkeypatch.setattr(tyro, "cli", cli)
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(("page", "line"), COMMANDS)
@pytest.mark.usefixtures("parse_alone")
def test_a_command_of_a_page_parses(page, line):
    words = shlex.split(line, comments=True)
    if Path(words[0]).name == "rumi":
        try:
            rumi.cli._carry_out(words[1], words[2:])
        except ParsedError:
            return
        except UsageError as error:  # a recording is looked for before the flags are read
            assert str(error).startswith("There is no "), error
            return
        assert words[1:] == ["tasks"], "it was carried out"
    elif words[0] == "python":
        script = words[2].replace(".", "/") if words[1] == "-m" else words[1].removesuffix(".py")
        known = words[1] == "-m" and words[2] in ("build", "sphinx", "rerun_cli")
        assert known or any((ROOT / f"{script}{end}").is_file() for end in (".py", "/__main__.py"))
    else:
        assert (ROOT / words[0]).is_file()


@pytest.mark.parametrize(
    ("page", "text"),
    [(name(page), text) for page in SHOWN for language, text in blocks(page) if language == "python"],
)
def test_python_of_a_page_compiles_and_its_names_are_there(page, text):
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and node.module.partition(".")[0] in LIBRARIES:
            module = importlib.import_module(node.module)
            assert all(hasattr(module, one.name) for one in node.names), ast.unparse(node)


@pytest.mark.parametrize("page", [ROOT / "README.md", *PAGES], ids=name)
def test_links_of_a_page_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        path = target.partition("#")[0]
        assert re.match(r"[a-z]+:", target) or not path or (page.parent / path).exists(), target


def test_every_page_that_the_code_names_is_there():
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("not a checkout")
    sources = (ROOT / one for one in listed.stdout.splitlines() if not one.startswith("scripts/results/"))
    for path in sources:
        if path.suffix in (".py", ".md", ".toml") and path.is_file():
            for page in re.findall(r"scripts/docs/[\w/.-]+\.(?:md|png)", path.read_text()):
                assert (ROOT / page).is_file(), f"{path} names {page}"


def words(page: Path) -> int:
    """Words outside of tables and code."""
    lines = re.sub(r"(?ms)^```.*?^```\n", "", page.read_text()).splitlines()
    return sum(len(line.split()) for line in lines if not line.startswith(("    ", "|")))


def test_words_by_hand_stay_few():
    assert words(ROOT / "README.md") <= 400
    assert sum(words(page) for page in PAGES if DOCS / "results" not in page.parents) <= 20_000


def test_the_tutorials_files_are_made(monkeypatch, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    monkeypatch.chdir(tmp_path)
    code = [text for language, text in blocks(DOCS / "tutorial" / "first-hour.md") if language == "python"]
    for text in code[1:]:
        exec(text, {})
    points = np.loadtxt("touches.csv", delimiter=",") - [0.4, 0.1, 0.0]
    mesh = trimesh.load("bracket.stl").apply_scale(0.001)
    _, off, _ = trimesh.proximity.closest_point_naive(mesh, points)
    assert points.shape == (20, 3) and off.max() < 2e-5


@pytest.mark.sim
@pytest.mark.slow
def test_the_tutorials_run(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    code = next(text for language, text in blocks(DOCS / "tutorial" / "first-hour.md") if language == "python")
    preset = rumi.preset
    monkeypatch.setattr(rumi, "preset", lambda *names, **values: preset("fast", **values, steps=1))
    exec(code, {})
    assert (tmp_path / "runs/from-python/result.json").is_file()
