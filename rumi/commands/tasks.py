"""The command `rumi tasks`: what there is to do."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import tyro

from rumi.exit_codes import DONE
from rumi.tasks.registry import TASKS


@dataclass(frozen=True)
class TasksOptions:
    """List the tasks, those of installed packages among them."""


def tasks(arguments: Sequence[str]) -> int:
    """`rumi tasks`: the tasks by name."""
    tyro.cli(TasksOptions, prog="rumi tasks", args=arguments)
    sys.stdout.write(listing())
    return DONE


def listing() -> str:
    """A line a task."""
    width = max(map(len, TASKS))
    return "".join(f"{name:<{width}}  {TASKS[name].description}\n" for name in TASKS)
