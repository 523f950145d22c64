"""Does the work that is missing, beside others that do the same."""

import errno
import os
import platform
import sys
import threading
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from multiprocessing import parent_process
from pathlib import Path
from typing import Self

from rumi.errors import UsageError
from rumi.runs.jsonlines import append_line, read_lines
from scripts.reproduce.jobs import Job
from scripts.reproduce.records import Records
from sdf.threads import using

if sys.platform != "win32":  # there one process at a time
    import fcntl

PAUSE_S = 0.5
"""How often someone who waits for others looks whether they are done."""


@dataclass(frozen=True)
class Errand:
    """What a worker is told.

    Attributes:
        jobs: all the work of a command, in order.
        path: file of the results.
        codes: hash of the code that the command was given with, by kind of work.
        cache_dir: folder that keeps what takes seconds to work out.
        session: of the command, so that what failed in it is not tried by each of its workers.
    """

    jobs: tuple[Job, ...]
    path: Path
    codes: Mapping[str, str]
    cache_dir: Path
    session: str

    @classmethod
    def of(cls, jobs: Sequence[Job], path: Path, cache_dir: Path) -> Self:
        """Some work by the present code, in a session of its own."""
        codes = {job.kind: job.code for job in jobs}
        session = f"{platform.node()} {os.getpid()} {time.time_ns()}"
        return cls(tuple(jobs), path.absolute(), codes, cache_dir.absolute(), session)

    @property
    def errors(self) -> Path:
        """File of what failed."""
        return self.path.with_name(f".{self.path.stem}.errors.jsonl")

    @property
    def claims(self) -> Path:
        """File that carries the locks of what is being done."""
        return self.path.with_name(f".{self.path.stem}.claims")


class Claims:
    """Which pieces of work a process has taken; the system gives them free when the process ends, however it ends.

    One lock a piece, on one byte of one file: nothing is left behind that would have to be cleaned up. Locks are the
    process's: within one process they keep nobody out.

    Args:
        path: of the file that carries the locks; made with its folder.
    """

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        # kept open until the process ends: closing it would drop all locks
        self._file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)

    def take(self, name: str) -> bool:
        """Claim a piece of work by a name of hexadecimal digits; False where another process has it."""
        try:
            if sys.platform != "win32":
                fcntl.lockf(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, _place(name))
        except OSError as error:
            # where a file system has no locks two may do the same work: then it is there twice
            return error.errno not in (errno.EACCES, errno.EAGAIN)
        return True

    def leave(self, name: str) -> None:
        """Give a piece of work back."""
        if sys.platform != "win32":
            fcntl.lockf(self._file, fcntl.LOCK_UN, 1, _place(name))


def work(errand: Errand, first: int = 0, of: int = 1) -> None:
    """Do all work that nobody has done; returns when all of it is done or has failed.

    Each piece is claimed first, by a lock that ends with the process: what another process does is waited for, and
    done here should it end before it is done. One thread for torch and for the kernels.

    Args:
        errand: what to do.
        first: where this worker's own share begins, which it does before the rest.
        of: how many share: its own is every `of`-th piece from there.

    Raises:
        UsageError: the code is not the one that the command was given with, or something asked for cannot be.
        ModuleNotFoundError: a package is not installed that some of the work needs.
        KeyboardInterrupt: interrupted; what is done stays.
    """
    changed = [kind for kind, code in errand.codes.items() if code != _code(errand, kind)]
    if changed:
        raise UsageError(f"The code changed since the command was given (of {', '.join(changed)}): give it again")
    records, claims = Records(errand.path), Claims(errand.claims)
    waiting = [*errand.jobs[first::of], *(job for k, job in enumerate(errand.jobs) if k % of != first)]
    with using(1):
        while waiting:
            left = [job for job in waiting if not _settle(job, errand, records, claims)]
            records.refresh()
            if left and len(left) == len(waiting):
                time.sleep(PAUSE_S)
            waiting = left


def failures(errand: Errand) -> dict[str, str]:
    """What failed in this session: the message by the id of the work.

    Raises:
        ModuleNotFoundError: a process could not go on for want of a package.
        UsageError: a process could not go on with what it was asked for.
    """
    own = [line for line, _ in read_lines(errand.errors) if line.get("session") == errand.session]
    for hopeless in (line["hopeless"] for line in own if "hopeless" in line):
        if hopeless["module"]:
            raise ModuleNotFoundError(hopeless["message"], name=hopeless["module"])
        raise UsageError(hopeless["message"])
    return {line["id"]: line["error"] for line in own}


def work_until_parent_ends(errand: Errand, first: int, of: int) -> None:
    """`work` in a process of its own, which ends with the one that started it, however that ends."""
    parent = parent_process()
    if parent is not None:

        def watch() -> None:
            parent.join()
            os._exit(1)

        threading.Thread(target=watch, daemon=True).start()
    try:
        work(errand, first, of)
    except KeyboardInterrupt:
        os._exit(130)  # the command says so
    except (ModuleNotFoundError, UsageError) as error:
        hopeless = {"message": str(error), "module": getattr(error, "name", None)}
        append_line(errand.errors, {"session": errand.session, "hopeless": hopeless})


def _settle(job: Job, errand: Errand, records: Records, claims: Claims) -> bool:
    """Do a piece of work unless it is done, has failed, or is being done; whether nothing is left to do for it."""
    if job.id in records.by_id:
        return True
    if not claims.take(job.id):
        return False
    try:
        # whoever had it before may have ended it since
        records.refresh()
        if job.id in records.by_id or job.id in failures(errand):
            return True
        try:
            result = job.carry_out(errand.cache_dir)
        except (ModuleNotFoundError, UsageError):
            raise  # so would all work of its kind
        except Exception as error:
            name = f"{job.task}, {job.column}, seed {job.seed}"
            said = {"session": errand.session, "id": job.id, "work": name, "error": f"{type(error).__name__}: {error}"}
            append_line(errand.errors, said | {"traceback": traceback.format_exc()})
        else:
            records.keep(job, result)
        return True
    finally:
        claims.leave(job.id)


def _code(errand: Errand, kind: str) -> str:
    return next(job.code for job in errand.jobs if job.kind == kind)


def _place(name: str) -> int:
    return int(name[:15], 16)  # below the largest offset of a file
