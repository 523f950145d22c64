"""Flags of commands whose every setting is one."""

import difflib
import textwrap
from collections.abc import Sequence

from rumi.errors import UsageError
from rumi.tasks.rummage.settings import setting_names


def asked_preset(arguments: Sequence[str]) -> str:
    """Name of the preset that a command line asks for."""
    for place, argument in enumerate(arguments):
        if argument.startswith("--preset="):
            return argument.removeprefix("--preset=")
        if argument == "--preset" and place + 1 < len(arguments):
            return arguments[place + 1]
    return "default"


def check_flags(arguments: Sequence[str], options: Sequence[str], on_off: Sequence[str]) -> None:
    """Refuse flags that are no setting, with those that are.

    Args:
        arguments: of the command line.
        options: of the command, beside the settings.
        on_off: those that take no value.
    """
    names = [name.replace("_", "-") for name in setting_names() if name != "task"] + [*options]
    switches = {f"{head}{dot}no-{tail}" for head, dot, tail in (name.rpartition(".") for name in [*names, *on_off])}
    known = {"help", *on_off, *names, *switches}
    for argument in arguments:
        name = argument[2:].split("=")[0].replace("_", "-")
        if not argument.startswith("--") or not name or name in known:
            continue
        close = difflib.get_close_matches(name, names, 3, 0.7)
        hint = f"; did you mean {' or '.join('--' + match for match in close)}?" if close else "."
        listed = textwrap.fill(" ".join(f"--{known}" for known in names), 110, break_on_hyphens=False)
        raise UsageError(f"There is no setting --{name}{hint} The settings are:\n{textwrap.indent(listed, '  ')}")
