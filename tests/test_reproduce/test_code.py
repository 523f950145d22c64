"""The hash sees what changes results and nothing else."""

import pytest

from scripts.reproduce import code
from scripts.reproduce.code import ROOTS, bare, code_hash, imported, reached

SOURCE = '''"""Module."""
import os  # for paths


def double(x):
    """Twice."""
    text = "# no comment"  # a comment

    return 2 * x, text


class Box:
    """A box."""

    side: int = 3
    """Of the box."""
'''


def test_words_do_not_count_and_code_does():
    assert bare(SOURCE) == (
        'import os\ndef double(x):\n    text = "# no comment"\n    return 2 * x, text\nclass Box:\n    side: int = 3\n'
    )
    rewritten = (
        SOURCE.replace("Twice.", "Two\n    times.\n    ").replace("  # a comment", "").replace("# for paths", "")
    )
    assert bare(rewritten) == bare(SOURCE)
    assert bare(SOURCE.replace("2 * x", "3 * x")) != bare(SOURCE)
    assert bare(SOURCE.replace("no comment", "none")) != bare(SOURCE)


def test_imports_are_seen_wherever_they_stand():
    source = (
        "import a.b\nfrom c import d\nfrom . import near\nfrom ..up import far\n"
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import never\nelse:\n    import other\n"
        "def f():\n    from late import thing\n"
    )
    found = set(imported(source, "pack.sub.mod"))
    assert {"a.b", "c", "c.d", "pack.sub", "pack.sub.near", "pack.up", "pack.up.far", "other", "late.thing"} <= found
    assert "never" not in found
    assert "pack.sub.near" in set(imported("from . import near", "pack.sub", package=True))


def test_a_run_depends_on_the_algorithm_and_not_on_what_shows_it():
    found = reached(ROOTS["run"])
    assert {
        "rumi.loop",
        "rumi.belief.pose_filter",
        "rumi.planning.costs_numba",
        "rumi.tasks.rummage.simulated",
        "kmppi.mppi",
        "sdf.se3",
    } <= found
    assert "scripts.reproduce.runs" in found
    shown = (
        "rumi.viz",
        "rumi.bench",
        "rumi.cli",
        "rumi.commands.run",
        "rumi.runs.folder",
        "rumi.commands.explain",
        "rumi.tasks.rummage.settings",
    )
    assert not [
        name for name in found if name.startswith((*shown, "scripts.reproduce.tables", "scripts.reproduce.toy"))
    ]
    toy = reached(ROOTS["toy"])
    assert "kmppi.parameterization" in toy and "rumi.loop" not in toy


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A project of three modules, of which the first imports the second."""
    monkeypatch.setattr(code, "ROOT", tmp_path)
    code_hash.cache_clear()
    for name, text in (("__init__", ""), ("a", "from rumi import b\n"), ("b", "value = 1\n"), ("c", "value = 2\n")):
        path = tmp_path / "rumi" / f"{name}.py"
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    yield tmp_path / "rumi"
    code_hash.cache_clear()


def test_the_hash_follows_what_is_imported(project):
    def now():
        code_hash.cache_clear()
        return code_hash(("rumi.a",))

    first = now()
    (project / "c.py").write_text("value = 3\n")
    (project / "b.py").write_text("value = 1  # one\n")
    assert now() == first
    (project / "b.py").write_text("value = 2\n")
    second = now()
    assert second != first
    (project / "a.py").write_text("def f():\n    from rumi import b, c\n")
    assert now() not in (first, second)
