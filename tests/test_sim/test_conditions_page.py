"""The page of the conditions: its numbers are the code's, and it names every use of the truth."""

import ast
import re
from pathlib import Path

from rumi.sim.conditions import MEMBERS

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "scripts" / "docs" / "reference" / "conditions.md"
_TASK = ("simulated", "robots", "point_camera", "depth_camera", "sensed", "free_region")
SENSING = (
    *sorted((ROOT / "rumi" / "sim").glob("*.py")),
    *(ROOT / "rumi" / "tasks" / "rummage" / f"{name}.py" for name in _TASK),
)
TRUTH = {"world_T_object", "_true", "exact", "cast", "_scene", "trace", "configuration"}
"""Attributes by which the simulator tells where and what object and tool truly are."""


def uses_of_truth(source):
    """Symbol and attribute of each reading of the truth in a source."""
    found = set()

    def walk(node, inside):
        for child in ast.iter_child_nodes(node):
            named = isinstance(child, ast.FunctionDef | ast.ClassDef)
            if isinstance(child, ast.Attribute) and child.attr in TRUTH and isinstance(child.ctx, ast.Load):
                found.add((".".join(inside), child.attr))
            walk(child, (*inside, child.name) if named else inside)

    walk(ast.parse(source), ())
    return found


def listed():
    """The same of the page's tables, with the file."""
    rows = re.findall(r"(?m)^\| `(rumi/[\w/]+\.py)` \| `([\w.]+)` \| ((?:`\w+`(?:, )?)+) \|", PAGE.read_text())
    return {(path, symbol, name) for path, symbol, names in rows for name in re.findall(r"\w+", names)}


def test_a_new_use_of_the_truth_is_seen():
    source = (
        "class Task:\n    def _view(self):\n        return self.world.world_T_object(), lambda: self._true.distance(0)"
    )
    assert uses_of_truth(source) == {("Task._view", "world_T_object"), ("Task._view", "_true")}


def test_the_page_lists_every_use_of_the_truth():
    found = {
        (str(path.relative_to(ROOT)), symbol, name)
        for path in SENSING
        for symbol, name in uses_of_truth(path.read_text(encoding="utf-8"))
    }
    missing, gone = found - listed(), listed() - found
    assert not missing, f"say on {PAGE.name} what a reading gets from {sorted(missing)}"
    assert not gone, f"{PAGE.name} names what is no longer there: {sorted(gone)}"


def test_the_pages_numbers_are_those_of_the_bundles():
    rows = re.findall(
        r"(?m)^\| `simulator\.([\w.]+)` \| ([^|]+) \| ([^|]+) \| ([^|]+) \| ([^|]+) \|$", PAGE.read_text()
    )
    shown = {name: tuple(part.strip() for part in parts) for name, *parts in rows}
    expected = {
        member.name: (member.group, *(f"{value:.4g}" if type(value) is float else str(value) for value in values))
        for member in MEMBERS
        for values in [(member.ideal, member.lab, member.harsh)]
    }
    assert shown == expected
