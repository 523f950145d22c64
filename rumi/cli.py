"""The command `rumi`: finds a subcommand by name, loads it and carries it out.

A subcommand is an address in a table, so that help is there at once: nothing is loaded before it is asked for.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from importlib import import_module
from types import FrameType
from typing import NamedTuple, NoReturn

from rumi import __version__, environment
from rumi.errors import DegenerateBeliefError, UsageError
from rumi.exit_codes import BAD_INPUT, DONE, INTERRUPTED
from rumi.garbage import put_off


class Command(NamedTuple):
    """A subcommand.

    Attributes:
        usage: what follows its name.
        summary: what it does, in a line.
        address: "module:function" of what carries it out, given the other arguments; it returns the exit code.
    """

    usage: str
    summary: str
    address: str


COMMANDS = {
    "tasks": Command("", "list the tasks", "rumi.commands.tasks:tasks"),
    "run": Command("TASK [options]", "carry out a task in simulation", "rumi.commands.run:run"),
    "replay": Command("LOG [options]", "take in a recorded log again", "rumi.commands.replay:replay"),
    "import": Command("BAG --map FILE", "make a log of a ROS bag", "rumi.commands.import_bag:import_bag"),
    "check": Command("LOG [options]", "draw a log's observations over the model", "rumi.commands.check:check"),
    "plot": Command("RUN [options]", "draw the figures of a run again", "rumi.commands.plot:plot"),
    "view": Command("RUN [options]", "look at a run in a viewer", "rumi.commands.view:view"),
    "result": Command("RUN [--json]", "the answer of a run: pose, covariance, why not", "rumi.commands.result:result"),
    "export": Command("RUN --to FORMAT [options]", "the answer for other programs", "rumi.commands.export:export"),
    "serve": Command("[options]", "find an object for a robot in another process", "rumi.commands.serve:serve"),
    "pushes": Command("RUN [options]", "learn how an object slides", "rumi.commands.pushes:pushes"),
    "calibrate": Command("TASK [options]", "whether beliefs cover the truth", "rumi.commands.calibrate:calibrate"),
    "leaderboard": Command("POLICY.py [options]", "rank a policy on a task", "rumi.commands.leaderboard:leaderboard"),
    "doctor": Command("[--json]", "what is installed and whether it works", "rumi.commands.doctor:doctor"),
    "bench": Command("[options]", "time each part on this machine", "rumi.bench.command:bench"),
    "mesh": Command("FILE [options]", "check a triangle mesh", "rumi.commands.mesh:mesh"),
    "localize": Command("MESH CONTACTS [options]", "poses by touched points", "rumi.commands.localize:localize"),
    "reproduce": Command("WHAT [options]", "the papers' tables and figures", "rumi.commands.checkout:reproduce"),
    "stress": Command("[options]", "compare the arithmetic with higher precision", "rumi.commands.checkout:stress"),
}  # fmt: skip
"""The subcommands by name, in the order of the help."""

_OWN_THREADS = ("bench", "stress", "view")
"""Those that choose their threads themselves: to measure, or since they may end before they need any."""

_Context = Callable[[], AbstractContextManager[None]]


def help_text() -> str:
    """What `rumi --help` prints."""
    usages = {f"rumi {name} {command.usage}".rstrip(): command.summary for name, command in COMMANDS.items()}
    width = max(map(len, usages))
    listed = "\n".join(f"  {usage:<{width}}  {summary}" for usage, summary in usages.items())
    return f"""\
rumi {__version__}: find the pose of an object by touching and pushing it.

{listed}

`rumi COMMAND --help` lists a command's options, `rumi run TASK --help` all settings of a task, with their defaults.

  rumi run mug-0                          leaves a folder runs/mug-0-rumi-default-s0
  rumi run mug-0 --preset paper --planner.mppi.samples 100 --stop.rule never
  rumi plot runs/mug-0-rumi-default-s0 --steps 0 4 8

Exit codes: 0 done, and a run succeeded by its own rule: the belief became sure and, where the task ends with a last
action (a grasp, a peg), that succeeded too; 1 it ran and did not succeed; 2 input that cannot be; 130 Ctrl-C.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Carry out a command line and return its exit code (`rumi.exit_codes`)."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    name = arguments[0] if arguments else ""
    if name in ("-h", "--help", "help", ""):
        (sys.stdout if name else sys.stderr).write(help_text())
        return DONE if name else BAD_INPUT
    if name == "--version":
        sys.stdout.write(f"rumi {__version__}\n")
        return DONE
    loading = put_off if argv is None else nullcontext  # a process that has a caller of this goes on after it
    return _guarded(lambda: _carry_out(name, arguments[1:], loading))


def script(work: Callable[[], object]) -> NoReturn:
    """Carry out what a script does, and end as `rumi` does: the same words and exit codes for what goes wrong.

    Args:
        work: what to do; the exit code is 0 unless it raises, `SystemExit` among others.
    """

    def done() -> int:
        work()
        return DONE

    sys.exit(_guarded(done))


def _carry_out(name: str, arguments: Sequence[str], loading: _Context = nullcontext) -> int:
    if name not in COMMANDS:
        raise UsageError(f"There is no command {name!r}; the commands are {', '.join(COMMANDS)}")
    if name in _OWN_THREADS:
        return _call(name, arguments, loading)
    # NumPy's library of linear algebra reads this when it is loaded; its threads spin, and matrices are small
    own = any(os.environ.get(variable) for variable in environment.LIBRARIES)
    with environment.variables({} if own else {"OPENBLAS_NUM_THREADS": "1"}):
        with loading():
            from sdf.threads import chosen  # loads torch: only now, so that help is quick

        with chosen():
            return _call(name, arguments, loading)


def _call(name: str, arguments: Sequence[str], loading: _Context = nullcontext) -> int:
    module, _, function = COMMANDS[name].address.partition(":")
    with loading():
        command = getattr(import_module(module), function)
    return int(command(arguments))


def _guarded(work: Callable[[], int]) -> int:
    """The exit code of some work; what goes wrong is said in a line or two."""
    with _interrupts() as noted:
        try:
            return work()
        except SystemExit as end:  # of the parser, which has said why, or with words
            if isinstance(end.code, str):
                sys.stderr.write(f"rumi: {end.code}\n")
            return DONE if end.code is None else end.code if isinstance(end.code, int) else BAD_INPUT
        except KeyboardInterrupt:
            return _interrupted()
        except BrokenPipeError:  # whoever read the output has seen enough
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            return DONE
        except Exception as error:
            if os.environ.get("RUMI_DEBUG"):
                raise
            # a library that Ctrl-C finds half loaded fails by an error of any kind; a full disk after it is still said
            if noted and not isinstance(error, (UsageError, DegenerateBeliefError, OSError)):
                return _interrupted()
            told = _of_memory(error) or error
            if not isinstance(told, (UsageError, DegenerateBeliefError, ValueError, OSError, ModuleNotFoundError)):
                raise
            return _refuse(told)


@contextmanager
def _interrupts() -> Iterator[list[int]]:
    """Signals of Ctrl-C that have come within the block; each raises KeyboardInterrupt, as without it."""
    noted: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        noted.append(number)
        raise KeyboardInterrupt

    # a handler of the caller's own stays, and so does that of a shell that has what it runs in the background ignore it
    main_thread = threading.current_thread() is threading.main_thread()
    if not main_thread or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield noted
        return
    before = signal.signal(signal.SIGINT, note)
    try:
        yield noted
    finally:
        signal.signal(signal.SIGINT, before)


def _interrupted() -> int:
    sys.stderr.write("rumi: interrupted\n")
    return INTERRUPTED


def _of_memory(error: Exception) -> UsageError | None:
    """What is said of memory that was asked for and is not there, by Python, by torch on a CPU or on a GPU."""
    said = str(error)
    of_torch = isinstance(error, RuntimeError) and any(
        part in said.lower() for part in ("can't allocate memory", "out of memory")
    )
    if not isinstance(error, MemoryError) and not of_torch:
        return None
    return UsageError(
        f"This needs more memory than there is: ask for fewer particles or samples{said and f' ({said})'}"
    )


def _refuse(error: Exception) -> int:
    """Say what is wrong, without a traceback."""
    message = str(error)
    if isinstance(error, ModuleNotFoundError):
        from sdf.extras import remedy

        how = remedy(error.name or "")
        message += "" if how in message else f": {how}"
    elif not isinstance(error, UsageError):
        message += "\n(RUMI_DEBUG=1 shows where this comes from)"
    sys.stderr.write(f"rumi: {message}\n")
    return BAD_INPUT
