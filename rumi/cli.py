"""The command `rumi`: what there is to give, and where each command lives."""

import os
import sys
from collections.abc import Callable, Sequence
from typing import NoReturn

from rumi import __version__, environment
from rumi.errors import DegenerateBeliefError, UsageError
from rumi.exit_codes import BAD_INPUT, DONE, INTERRUPTED

COMMANDS = ("tasks", "run", "replay", "import", "check", "plot", "bench", "mesh", "localize", "reproduce", "stress")
OWN_THREADS = ("bench", "stress")
"""Commands that measure, and choose their threads themselves: not by what is free just now."""
HOMES = {"import": "import_bag"}
"""Names of the functions whose commands have names that no function can have."""
EXTRAS = {
    "mujoco": "sim",
    "pytorch_kinematics": "robot",
    "matplotlib": "plot",
    "PIL": "plot",
    "contourpy": "plot",
    "trimesh": "mesh",
    "scipy": "mesh",
    "networkx": "mesh",
    "coacd": "mesh",
    "submitit": "cluster",
    "cv2": "vision",
    "h5py": "logs",
    "rosbags": "logs",
    "mpmath": "stress",
    "hypothesis": "stress",
}
"""Which extra brings a package that may be missing."""

HELP = f"""\
rumi {__version__}: find the pose of an object by touching and pushing it.

usage: rumi tasks                  what there is to find
       rumi run TASK [options]     find it, in simulation
       rumi replay LOG [options]   take in a recorded log, by the same settings or by others
       rumi import BAG --map FILE  make a log of a ROS 2 bag
       rumi check LOG [options]    draw what was observed over the model: is the calibration right?
       rumi plot RUN [options]     draw the figures of a run again
       rumi bench [options]        time the work, against others' and against the targets
       rumi mesh FILE [options]    what a triangle mesh is like, and what is wrong with it
       rumi localize MESH CONTACTS [options]   where it is, from points that were touched on it
       rumi reproduce WHAT ...     the paper's tables and figures, beside the paper's own
       rumi stress [options]       hold the arithmetic to references of higher precision
       rumi --version

       rumi run --help             all settings, with their defaults

examples:
  rumi run mug-0                            the default method; leaves a folder runs/mug-0-rumi-default-s0
  rumi run mug-1 --method info-only --seed 3
  rumi run mug-0 --preset paper --steps 10 --out my-run
  rumi run mug-0 --planner.mppi.samples 100 --stop.rule never
  rumi run touch-box                        a box that only touch can tell, found, grasped and lifted
  rumi run peg --t-max 10                   a block found by touch under a deadline, a peg put into it
  rumi plot runs/mug-0-rumi-default-s0 --steps 0 4 8

`rumi run` ends with exit code 0 if the belief became sure by its own stopping rule, 1 if it did not, 2 for input
that cannot be, and 130 after Ctrl-C. What was done until then is in the run's folder: a run to read, replay and plot;
of touch-box settings and pokes; of peg, and of what was interrupted before its first view, nothing, and no folder.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Carry out a command line and return its exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    name = arguments[0] if arguments else ""
    if name in ("-h", "--help", "help", ""):
        (sys.stdout if name else sys.stderr).write(HELP)
        return DONE if name else BAD_INPUT
    if name == "--version":
        sys.stdout.write(f"rumi {__version__}\n")
        return DONE
    return _guarded(lambda: _command(name, arguments[1:]))


def script(work: Callable[[], object]) -> NoReturn:
    """Carry out what a script does, and end as `rumi` does: the same words and exit codes for what goes wrong.

    Args:
        work: what to do; the exit code is 0 unless it raises, `SystemExit` among others.
    """

    def done() -> int:
        work()
        return DONE

    sys.exit(_guarded(done))


def _command(name: str, arguments: Sequence[str]) -> int:
    if name not in COMMANDS:
        raise UsageError(f"There is no command {name!r}; the commands are {', '.join(COMMANDS)}")
    if name in OWN_THREADS:
        return _carry_out(name, arguments)
    # NumPy's library of linear algebra reads this when it is loaded; its threads spin, and matrices are small
    own = any(os.environ.get(variable) for variable in environment.LIBRARIES)
    with environment.variables({} if own else {"OPENBLAS_NUM_THREADS": "1"}):
        from sdf.threads import chosen

        with chosen():
            return _carry_out(name, arguments)


def _carry_out(name: str, arguments: Sequence[str]) -> int:
    from rumi.commands import table as commands  # loads torch: only now, so that help is quick

    return int(getattr(commands, HOMES.get(name, name))(arguments))


def _guarded(work: Callable[[], int]) -> int:
    """The exit code of some work; what goes wrong is said in a line or two."""
    try:
        return work()
    except SystemExit as end:  # of the parser, which has said why, or with words
        if isinstance(end.code, str):
            sys.stderr.write(f"rumi: {end.code}\n")
        return DONE if end.code is None else end.code if isinstance(end.code, int) else BAD_INPUT
    except KeyboardInterrupt:
        sys.stderr.write("rumi: interrupted\n")
        return INTERRUPTED
    except BrokenPipeError:  # whoever read the output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return DONE
    except (UsageError, DegenerateBeliefError, ValueError, OSError, ModuleNotFoundError) as error:
        if os.environ.get("RUMI_DEBUG"):
            raise
        return _refuse(error)


def _refuse(error: Exception) -> int:
    """Say what is wrong, without a traceback."""
    message = str(error)
    if isinstance(error, ModuleNotFoundError):
        package = (error.name or "").split(".")[0]
        message += f": pip install 'rumi[{EXTRAS[package]}]'" if package in EXTRAS else ""
    elif not isinstance(error, UsageError):
        message += "\n(RUMI_DEBUG=1 shows where this comes from)"
    sys.stderr.write(f"rumi: {message}\n")
    return BAD_INPUT
