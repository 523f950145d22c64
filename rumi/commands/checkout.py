"""`rumi reproduce` and `rumi stress`: experiments that lie beside the library in a checkout."""

import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType

from rumi.cache import cache_folder
from rumi.errors import UsageError


def reproduce(arguments: Sequence[str]) -> int:
    """`rumi reproduce`: the papers' tables and figures."""
    touch = _module("scripts.reproduce.touch", "rumi reproduce")
    if touch.asked_for(arguments):
        return int(touch.reproduce_touch(arguments, cache_dir=cache_folder()))
    command = _module("scripts.reproduce.command", "rumi reproduce")
    return int(command.reproduce(arguments, cache_dir=cache_folder()))


def stress(arguments: Sequence[str]) -> int:
    """`rumi stress`: how far the arithmetic is off."""
    return int(_module("tests.stress.command", "rumi stress").stress(arguments))


def _module(name: str, command: str) -> ModuleType:
    """A module of the experiments, which are not installed with the library."""
    root = Path(__file__).resolve().parents[2]
    if not root.joinpath(*name.split(".")).with_suffix(".py").is_file():
        raise UsageError(
            f"`{command}` is part of the checkout and not of the installed package: clone rumi, then pip install -e ."
        )
    if str(root) not in sys.path:
        sys.path.insert(0, str(root))
    return import_module(name)
