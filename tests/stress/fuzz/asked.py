"""What users ask for: settings read from JSON, and command lines."""

import contextlib
import io
import json
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from torch import Tensor

from rumi.cli import COMMANDS, main
from rumi.commands.run import parse
from rumi.exit_codes import BAD_INPUT, DONE, NOT_CONVERGED
from rumi.runs.json_settings import setting_names
from rumi.tasks.rummage.settings import PRESETS, Settings, from_dict, preset, to_dict
from tests.stress.fuzz.draw import WILD, Draw, choice, number
from tests.stress.fuzz.files import damaged, originals

Target = Callable[[Draw], Iterable[Tensor]]

_ODD: tuple[Any, ...] = (None, True, -1, 0, 10**30, "", "nan", "x", [], {}, [1, 2], {"a": 1}, *WILD)


def _settings(draw: Draw) -> Iterable[Tensor]:
    """Settings of a preset, some of them something else; what is taken comes back the same."""
    values = to_dict(preset(choice(draw, tuple(PRESETS))))
    for _ in range(draw.integer(0, 3)):
        inner = values
        while True:
            name = choice(draw, sorted(inner))
            if isinstance(inner[name], dict) and inner[name] and draw.integer(0, 9):
                inner = inner[name]
                continue
            break
        inner[choice(draw, (name, name, name, "other"))] = choice(draw, _ODD) if draw.integer(0, 2) else number(draw)
    taken = from_dict(values)
    assert isinstance(taken, Settings)
    again = from_dict(json.loads(json.dumps(to_dict(taken), allow_nan=False)))
    if to_dict(again) != to_dict(taken):
        raise AssertionError("settings came back from JSON as others")
    return ()


_NAMES = setting_names(Settings)
_WORDS = (
    "",
    "mug-0",
    "mug-1",
    "-1",
    "0",
    "3",
    "nan",
    "inf",
    "1e999",
    "--",
    "-",
    "--help",
    "\x00",
    "é",
    "a" * 300,
    "=",
    "[]",
)


def _flags(draw: Draw) -> Iterable[Tensor]:
    """Command lines of `rumi run`, up to where the run would begin."""
    arguments = [choice(draw, ("mug-0", "mug-0", "no-such-task", "--seed"))]
    for _ in range(draw.integer(0, 4)):
        name = "--" + choice(draw, _NAMES).replace("_", "-")
        kind = draw.integer(0, 3)
        if kind == 0:
            arguments.append(f"{name}={choice(draw, _WORDS)}")
        elif kind == 1:
            arguments += [name, choice(draw, _WORDS)]
        elif kind == 2:
            arguments += [name, str(number(draw, wild=True))]
        else:
            arguments.append(choice(draw, _WORDS))
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        try:
            parse(arguments)
        except SystemExit as end:
            if end.code not in (0, 2):
                raise AssertionError(f"ended with {end.code!r}") from end
    return ()


def _commands(draw: Draw) -> Iterable[Tensor]:
    """Whole commands that read files or refuse at once; exit code 0, 1 or 2 and no traceback."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        mesh = folder / f"mesh.{choice(draw, ('obj', 'off', 'ply', 'stl'))}"
        contacts = folder / f"contacts.{choice(draw, ('csv', 'off', 'ply', 'npz'))}"
        for path in (mesh, contacts):
            data = originals()[path.name]
            path.write_bytes(damaged(draw, data) if draw.integer(0, 2) else data)
        lines = [
            ["mesh", str(mesh), "--no-such-flag"],
            ["mesh", str(mesh.with_suffix(".txt"))],
            ["plot", str(folder)],
            ["plot", str(folder / "missing")],
            ["localize", str(mesh), str(contacts), "--starts", "0"],
            ["localize", str(folder), str(contacts), "--starts", "1"],
            ["localize", str(mesh), str(folder), "--scale", str(number(draw, wild=True))],
            # no threads at all: some of the words are parts of cases' names, which take minutes
            ["bench", "--only", choice(draw, _WORDS) or "x", "--threads", "0"],
            ["bench", "--threads", "0", "--only", "no-such-case"],
            ["reproduce", choice(draw, _WORDS)],
            ["stress", "--minutes", choice(draw, ("nan", "-1", "0"))],
            ["stress", "--only", choice(draw, _WORDS) or "x", "--list"],
            ["run", choice(draw, ("no-such-task", "\x00")), "--steps", str(draw.integer(-3, -1))],
            ["run", "mug-0", "--steps", str(10**6)],
            [choice(draw, (*COMMANDS, "", "--version", "--help", "tasks")), "--help"],
            ["tasks", choice(draw, _WORDS)],
        ]
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), contextlib.chdir(folder):
            code = main(choice(draw, lines))
        if code not in (DONE, NOT_CONVERGED, BAD_INPUT) or "Traceback" in err.getvalue():
            raise AssertionError(f"ended with {code} and {err.getvalue()[-200:]}")
        if [path.name for path in folder.iterdir() if path not in (mesh, contacts)]:
            raise AssertionError("something was left behind")
    return ()


ASKED: dict[str, Target] = {"settings": _settings, "flags": _flags, "commands": _commands}
"""Targets by name."""
