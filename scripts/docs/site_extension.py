"""Directives of the pages: tables of commands, tasks and settings, made of the code when the site is built."""

import dataclasses
import inspect
import re
import typing
from collections.abc import Iterator
from importlib import import_module
from typing import Any

import docstring_parser
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective


class CommandTable(SphinxDirective):
    """The subcommands of `rumi`, each with what it does."""

    def run(self) -> list[nodes.Node]:
        """Nodes of the table."""
        from rumi.cli import COMMANDS

        rows = [(f"`{f'rumi {name} {one.usage}'.rstrip()}`", one.summary) for name, one in COMMANDS.items()]
        return self.parse_text_to_nodes(table(("command", "what it does"), rows))


class TaskTable(SphinxDirective):
    """The tasks of `rumi run`, each with its presets."""

    def run(self) -> list[nodes.Node]:
        """Nodes of the table."""
        from rumi.tasks.registry import TASKS

        rows = [(f"`{name}`", TASKS[name].description, ", ".join(TASKS[name].presets)) for name in TASKS]
        return self.parse_text_to_nodes(table(("task", "what there is to do", "presets"), rows))


class SettingsTable(SphinxDirective):
    """The settings of a task as flags of `rumi run`, with the values of its first preset."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Nodes of the table."""
        from rumi.tasks.registry import TASKS

        entry = TASKS[self.arguments[0]]
        rows = [(f"`--{flag}`", f"`{value}`", about) for flag, value, about in flags(entry.preset(entry.presets[0]))]
        return self.parse_text_to_nodes(table(("flag", "default", "meaning"), rows))


def flags(settings: Any, prefix: str = "") -> Iterator[tuple[str, str, str]]:  # noqa: ANN401  (any dataclass)
    """Flag, value and meaning of each setting, those of nested dataclasses with dots."""
    meanings = {
        one.arg_name: " ".join((one.description or "").split())
        for kind in reversed(type(settings).__mro__)
        for one in docstring_parser.parse(inspect.getdoc(kind) or "").params
    }
    hints = typing.get_type_hints(type(settings), include_extras=True)
    for one in dataclasses.fields(settings):
        value = getattr(settings, one.name)
        named = [extra.name for extra in getattr(hints[one.name], "__metadata__", ()) if hasattr(extra, "name")]
        name = named[0] if named and named[0] is not None else one.name.replace("_", "-")
        flag = ".".join(part for part in (prefix, name) if part)
        if dataclasses.is_dataclass(value):
            yield from flags(value, flag)
        else:
            yield flag, str(value) or "(empty)", meanings.get(one.name, "")


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """A table in Markdown."""
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def load_public_names(_: Sphinx) -> None:
    """Load the public names: packages bring them when they are first asked for, autodoc lists what is there."""
    for package in ("rumi", "sdf", "sensors"):
        module = import_module(package)
        for name in module.__all__:
            getattr(module, name)


def as_restructured_text(*given: Any) -> None:  # noqa: ANN401  (app, kind, name, object, options, lines)
    """Escape stars and bars of shapes in a docstring, and mark indented code as such, in place."""
    lines = given[-1]
    found: list[str] = []
    for k, line in enumerate(lines):
        if k > 1 and line.startswith("    ") and not lines[k - 1].strip() and not lines[k - 2].startswith("    "):
            found += ["::", ""]
        code = line.startswith(("    ", ">>>")) and "::" in found[-2:]
        found.append(line if code else _escaped(line))
    lines[:] = found


def _escaped(line: str) -> str:
    """A line with its stars and bars escaped, but for those within backticks."""
    parts = line.split("`")
    parts[::2] = [re.sub(r"(?<![\w*])\*(?=\w)|\|", r"\\\g<0>", part) for part in parts[::2]]
    return "`".join(parts)


def setup(app: Sphinx) -> dict[str, bool]:
    """What Sphinx calls."""
    app.connect("builder-inited", load_public_names)
    app.connect("autodoc-process-docstring", as_restructured_text, priority=400)
    app.add_directive("rumi-commands", CommandTable)
    app.add_directive("rumi-tasks", TaskTable)
    app.add_directive("rumi-settings", SettingsTable)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
