"""A hash over the code that a result depends on, so that results of other code are not taken for this one's."""

import ast
import hashlib
import io
import json
import tokenize
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("sdf", "sensors", "kmppi", "rumi", "scripts")
APART = ("rumi.tasks.rummage.settings", "rumi.tasks.registry", "rumi.runs.scene_geometry")
"""What does not count: settings, which count by their values, the list of tasks, and what is only looked at."""

ROOTS: dict[str, tuple[str, ...]] = {
    "run": ("scripts.reproduce.runs",),
    "toy": ("scripts.reproduce.toy",),
    "peg": ("scripts.reproduce.peg",),
    "peg-real": ("scripts.reproduce.peg",),
    "touch-box": ("rumi.tasks.touch_box.build",),
    "touch-ablation": ("rumi.tasks.touch_box.build",),
    "push-run": ("rumi.tasks.rummage.build", "rumi.loop"),
    "first-day": ("rumi.tasks.rummage.build", "rumi.loop", "scripts.first_day"),
    "prediction": ("rumi.tasks.rummage.build", "rumi.loop", "scripts.bench.prediction"),
    "localize": ("rumi.registration.from_contacts",),
    "torques": ("rumi.sim.torque_arm",),
    "vision": ("sensors.vision.cloud", "sensors.touch.bubble", "scripts.bench.known_scenes"),
    "mesh": ("sdf.mesh.build",),
}
"""Modules that the results of each kind of work depend on, with all that they import."""

SAME_CODE = ROOT / "scripts" / "results" / "same_code.json"
"""Hashes of earlier code with the hash that their results count as: `scripts.reproduce.same_code` writes them."""


def code_of(kind: str) -> str:
    """Hash of the code that a kind of work depends on."""
    return code_hash(ROOTS[kind])


def present_code(code: str) -> str:
    """The hash that one counts as: another where the code of both is on record as the same, else itself."""
    known = same_code()
    for _ in known:  # as often as there are steps at most
        code = known.get(code, code)
    return code


@cache
def same_code() -> dict[str, str]:
    """Earlier hashes with the later ones that they count as."""
    if not SAME_CODE.is_file():
        return {}
    return {line["old"]: line["new"] for line in json.loads(SAME_CODE.read_text(encoding="utf-8"))}


@cache
def code_hash(roots: tuple[str, ...]) -> str:
    """Hash of the modules that some modules reach by import statements, these included.

    Comments, docstrings and blank lines do not count. Imports within functions do; what is imported under
    TYPE_CHECKING, or by a name that is made at run time, does not.

    Args:
        roots: full names of modules of this project.
    """
    digest = hashlib.sha256()
    for name in sorted(reached(roots)):
        digest.update(f"{name}\n{bare(_path(name).read_text(encoding='utf-8'))}".encode())  # type: ignore[union-attr]
    return digest.hexdigest()[:12]


def reached(roots: Sequence[str]) -> set[str]:
    """Full names of the project's modules that are loaded with some of them, however late."""
    found: set[str] = set()
    waiting = list(roots)
    while waiting:
        name = waiting.pop()
        path = _path(name)
        if name in found or path is None or name in APART:
            continue
        found.add(name)
        waiting += [name.rpartition(".")[0], *imported(path.read_text(encoding="utf-8"), name, path.stem == "__init__")]
    return found


@cache
def imported(source: str, name: str, package: bool = False) -> tuple[str, ...]:
    """Names that a module imports; `from a import b` gives both a and a.b, either of which may be a module.

    Args:
        source: of the module.
        name: its full name, which relative imports start from.
        package: whether it is a package's `__init__`.
    """
    found: list[str] = []
    for node in _run(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = name.split(".")
                parts = parts[: len(parts) - node.level + package]
                base = ".".join([*parts, base] if base else parts)
            found += [base, *(f"{base}.{alias.name}" for alias in node.names)]
    return tuple(found)


@cache
def bare(source: str) -> str:
    """A source without comments, docstrings and blank lines."""
    lines = source.splitlines(keepends=True)
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column] + "\n"
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            for part in node.body:
                # a string that stands alone: a docstring, or one that describes the name before it
                if (
                    isinstance(part, ast.Expr)
                    and isinstance(part.value, ast.Constant)
                    and type(part.value.value) is str
                ):
                    lines[part.lineno - 1 : part.end_lineno] = [""] * (
                        (part.end_lineno or part.lineno) - part.lineno + 1
                    )
    return "".join(line.rstrip() + "\n" for line in lines if line.strip())


def _run(tree: ast.AST) -> Iterator[ast.AST]:
    """All nodes but those under `if TYPE_CHECKING`."""
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        yield node
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            waiting += node.orelse
        else:
            waiting += ast.iter_child_nodes(node)


def _path(name: str) -> Path | None:
    """The file of a module of this project."""
    if name.split(".")[0] not in PACKAGES:
        return None
    path = ROOT.joinpath(*name.split("."))
    for found in (path / "__init__.py", path.with_suffix(".py")):
        if found.is_file():
            return found
    return None
