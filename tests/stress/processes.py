"""Whole commands in processes of their own, to be ended at a moment that is told by what they have computed so far.

They are copies of a process that has loaded all they need, so that what is killed is their work and not their loading.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Self

from sdf import backend

POLL_S = 0.004
LONGEST_S = 600.0
"""A command of a second that takes this long hangs."""
_NEEDED = (
    "rumi.commands.run",
    "rumi.tasks.rummage.build",
    "rumi.loop",
    "scripts.reproduce.command",
    "rumi.tasks.rummage.simulated",
    "rumi.tasks.peg.entry",
)
_OPTIONAL = ("sensors.log.writer",)


@dataclass(frozen=True)
class Command:
    """A command that runs.

    Attributes:
        pid: of its process.
        out, err: files that take what it writes.
    """

    server: "Commands"
    pid: int
    out: Path
    err: Path

    def kill_after(self, seconds: float) -> bool:
        """Kill it once it has used so many seconds of a processor; False where it had ended by itself before.

        Seconds of computing, where the system tells them: they come at the same point of its work on a busy machine.
        """
        began = time.monotonic()
        if self._ended(lambda: _used(self.pid, began) >= seconds) is not None:
            return False
        os.kill(self.pid, signal.SIGKILL)  # nobody waits for it but by asking: the number is still its own
        ended = self._ended(lambda: False)
        return ended is not None and os.WIFSIGNALED(int(ended[0]))

    def finish(self, accepted: Sequence[int]) -> float:
        """Wait for its end; the seconds of a processor that it used.

        Raises:
            AssertionError: it ended with another exit code than those, or with a traceback.
        """
        ended, said = self._ended(lambda: False), self.err.read_text()
        code = None if ended is None else os.waitstatus_to_exitcode(int(ended[0]))
        if ended is None or code not in accepted or "Traceback" in said:
            raise AssertionError(f"a command ended with {code}: {said[-500:]}")
        return ended[1]

    def _ended(self, until: Callable[[], bool]) -> tuple[float, float] | None:
        """Status and seconds of a processor of a process that has ended; None where something held before."""
        began = time.monotonic()
        while (ended := self.server.ask({"ended": self.pid})) is None and not until():
            if time.monotonic() - began > LONGEST_S:
                os.kill(self.pid, signal.SIGKILL)
                raise AssertionError(f"a command hangs: {self.err.read_text()[-500:]}")
            time.sleep(POLL_S)
        return None if ended is None else (ended[0], ended[1])


class Commands:
    """Starts commands, on one thread and with the plain versions, which need not be compiled; a context manager.

    Args:
        further: environment variables.
    """

    def __init__(self, further: Mapping[str, str] | None = None) -> None:
        root = str(Path(__file__).resolve().parent.parent.parent)
        path = os.pathsep.join((root, *filter(None, [os.environ.get("PYTHONPATH")])))
        own = {"OMP_NUM_THREADS": "1", backend.VARIABLE: backend.PLAIN, "PYTHONPATH": path}
        self._process = subprocess.Popen(
            [sys.executable, "-c", "from tests.stress.processes import serve; serve()"],
            env={**os.environ, **own, **(further or {})},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def begin(
        self, arguments: Sequence[str], folder: Path, name: str, *, cache: Path, grow: int | None = None
    ) -> Command:
        """Start `rumi` with some arguments.

        Args:
            arguments: of the command line.
            folder: where it works.
            name: of the files that take what it writes.
            cache: its folder of caches.
            grow: bytes that no file may grow beyond, as on a disk that becomes full.
        """
        folder.mkdir(parents=True, exist_ok=True)
        out, err = folder / f"{name}.out", folder / f"{name}.err"
        asked = {"arguments": [*arguments], "folder": str(folder), "out": str(out), "err": str(err)}
        return Command(self, self.ask(asked | {"cache": str(cache), "grow": grow}), out, err)

    def ask(self, what: Mapping[str, Any]) -> Any:  # noqa: ANN401  (a number, or two, or nothing)
        """One question to the process that starts commands, and its answer."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(what) + "\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        if not answer:
            raise RuntimeError("The process that starts commands has ended")
        return json.loads(answer)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()


def serve() -> None:
    """Read questions from standard input until it ends: to start a command, or whether one has ended."""
    import torch

    torch.set_num_threads(1)
    for name in _NEEDED:
        import_module(name)
    for name in _OPTIONAL:
        with suppress(ModuleNotFoundError):
            import_module(name)
    answers = os.fdopen(os.dup(1), "w")
    for line in sys.stdin:
        asked = json.loads(line)
        if "ended" in asked:
            pid, status, usage = os.wait4(asked["ended"], os.WNOHANG)
            answer: Any = [status, usage.ru_utime + usage.ru_stime] if pid else None
        elif not (answer := os.fork()):
            _carry_out(asked)
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


def _carry_out(asked: Mapping[str, Any]) -> None:
    """Become the command that is asked for."""
    import resource

    code = 1
    try:
        os.environ["RUMI_CACHE"] = asked["cache"]
        os.chdir(asked["folder"])
        null = os.open(os.devnull, os.O_RDONLY)
        files = [null, *(os.open(asked[name], os.O_WRONLY | os.O_CREAT | os.O_TRUNC) for name in ("out", "err"))]
        for number, file in enumerate(files):
            os.dup2(file, number)
        if asked["grow"] is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (asked["grow"], asked["grow"]))
        from rumi.cli import main

        code = main(asked["arguments"])
        sys.stdout.flush()
    finally:
        sys.stderr.flush()
        os._exit(code)


def _used(pid: int, began: float) -> float:
    """Seconds of a processor that a process used; those of the clock where the system does not tell."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError, ValueError):
        return time.monotonic() - began
