"""What the commands of `rumi` do."""

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Annotated, NamedTuple

import tyro

from rumi.errors import UsageError
from rumi.exit_codes import DONE


@dataclass(frozen=True)
class PlotOptions:
    """Draw the figures of a run again, also of one that goes on or was interrupted.

    Attributes:
        run: folder of the run.
        steps: scenes to draw; by default the first view, the first contact, the middle and the end.
        out: folder of the figures; by default RUN/figures.
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    steps: tuple[int, ...] | None = None
    out: Path | None = None


def tasks(arguments: Sequence[str]) -> int:
    """`rumi tasks`: the tasks by name."""
    from rumi.tasks.rummage.scenes import TASKS

    tyro.cli(_Nothing, prog="rumi tasks", args=arguments, description="List what there is to find.")
    listed = {name: spec.description for name, spec in TASKS.items()}
    listed |= {name: own.description for name, own in _own_tasks().items()}
    width = max(map(len, listed))
    for name, description in listed.items():
        sys.stdout.write(f"{name:<{width}}  {description}\n")
    return DONE


@dataclass(frozen=True)
class _Nothing:
    """No options."""


class _Own(NamedTuple):
    """A task with settings of its own.

    Attributes:
        description: in a line.
        run: carries out `rumi run` of it, given the other arguments.
    """

    description: str
    run: Callable[..., int]


def _own_tasks() -> dict[str, _Own]:
    """Tasks that are not rummaging's, by name."""
    from rumi.commands import run_handle as fused_command
    from rumi.commands import run_peg as peg_command
    from rumi.commands import run_touch_box as touch

    return {
        touch.NAME: _Own(touch.DESCRIPTION, touch.run_touch),
        peg_command.NAME: _Own(peg_command.DESCRIPTION, peg_command.peg),
        fused_command.NAME: _Own(fused_command.DESCRIPTION, fused_command.fused),
    }


def run(arguments: Sequence[str]) -> int:
    """`rumi run`: one run, its folder and its figures."""
    from rumi.commands import run as run_command

    for name, own in _own_tasks().items():
        at = arguments.index(name) if name in arguments else -1
        if at == 0 or (at > 0 and not arguments[at - 1].startswith("--")):  # not the value of a flag
            return own.run([*arguments[:at], *arguments[at + 1 :]], cache_dir=cache_folder())
    return run_command.run(arguments, cache_dir=cache_folder())


def replay(arguments: Sequence[str]) -> int:
    """`rumi replay`: a recorded log in the robot's place."""
    from rumi.commands import replay as replay_command

    return replay_command.replay(arguments, cache_dir=cache_folder())


def import_bag(arguments: Sequence[str]) -> int:
    """`rumi import`: a ROS 2 bag as a log."""
    from rumi.commands import import_bag as bag_command

    return bag_command.import_bag(arguments)


def check(arguments: Sequence[str]) -> int:
    """`rumi check`: a log's observations over the model."""
    from rumi.commands import check as check_command

    return check_command.check(arguments, cache_dir=cache_folder())


def plot(arguments: Sequence[str]) -> int:
    """`rumi plot`: the figures of a run."""
    options = tyro.cli(PlotOptions, prog="rumi plot", args=arguments)
    from rumi.commands.run import draw_figures

    for path in draw_figures(options.run, options.out or options.run / "figures", options.steps):
        sys.stdout.write(f"{path}\n")
    return DONE


def bench(arguments: Sequence[str]) -> int:
    """`rumi bench`: how long the work takes."""
    from rumi.bench import command

    return command.bench(arguments, cache_dir=cache_folder())


def mesh(arguments: Sequence[str]) -> int:
    """`rumi mesh`: what a mesh is like."""
    from rumi.commands import mesh as mesh_command

    return mesh_command.mesh(arguments)


def localize(arguments: Sequence[str]) -> int:
    """`rumi localize`: where an object is, from touched points."""
    from rumi.commands import localize as localize_command

    return localize_command.localize(arguments)


def reproduce(arguments: Sequence[str]) -> int:
    """`rumi reproduce`: the paper's tables and figures."""
    touch = _of_the_checkout("scripts.reproduce.touch", "rumi reproduce")
    if touch.asked_for(arguments):
        return int(touch.reproduce_touch(arguments, cache_dir=cache_folder()))
    command = _of_the_checkout("scripts.reproduce.command", "rumi reproduce")
    return int(command.reproduce(arguments, cache_dir=cache_folder()))


def stress(arguments: Sequence[str]) -> int:
    """`rumi stress`: how far the arithmetic is off."""
    return int(_of_the_checkout("tests.stress.command", "rumi stress").stress(arguments))


def _of_the_checkout(module: str, command: str) -> ModuleType:
    """A module of the experiments, which lie beside the library in a checkout and are not installed with it."""
    root = Path(__file__).resolve().parents[2]
    if not root.joinpath(*module.split(".")).with_suffix(".py").is_file():
        raise UsageError(
            f"`{command}` is part of the checkout and not of the installed package: clone rumi, then pip install -e ."
        )
    if str(root) not in sys.path:
        sys.path.insert(0, str(root))
    return import_module(module)


def cache_folder() -> Path:
    """Folder for what takes long to work out: $RUMI_CACHE, else the user's cache."""
    own = os.environ.get("RUMI_CACHE")
    if own:
        return Path(own)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rumi"
