"""Who does the work: processes of this machine, or jobs of a cluster."""

import os
import time
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from rumi.environment import LIBRARIES, variables
from rumi.errors import UsageError
from scripts.reproduce.records import Records
from scripts.reproduce.worker import PAUSE_S, Errand, failures, work, work_until_parent_ends
from sdf.extras import optional

_ONE_THREAD = dict.fromkeys(LIBRARIES, "1")
GRACE_S = 3.0


def on_this_machine(errand: Errand, jobs: int) -> None:
    """Do the work in some processes, or in this one where one is enough.

    Each has one thread. They end with this process, also if it is killed.

    Args:
        errand: what to do.
        jobs: processes at once.

    Raises:
        KeyboardInterrupt: after the processes have ended.
    """
    if jobs == 1:
        work(errand)
        return
    context = get_context("spawn")
    processes = [
        context.Process(target=work_until_parent_ends, args=(errand, k, jobs), daemon=True) for k in range(jobs)
    ]
    try:
        with variables(_ONE_THREAD):  # which a process reads when it loads torch
            for process in processes:
                process.start()
        for process in processes:
            process.join()
    finally:
        _end(processes)


def _end(processes: Sequence[Any]) -> None:
    """End those that are left: what they were doing is not kept, what they have done is."""
    alive = [process for process in processes if process.pid is not None]
    for process in alive:
        if process.is_alive():
            process.terminate()
    for process in alive:
        process.join(GRACE_S)
        if process.is_alive():
            process.kill()


def on_a_cluster(
    errand: Errand, jobs: int, folder: Path, parameters: dict[str, Any], *, cluster: str | None = None
) -> None:
    """Do the work in jobs that submitit hands to SLURM, and wait for them.

    Should this process end before them, they go on; the command given again waits for what they do.

    Args:
        errand: what to do; its file must lie where all can write.
        jobs: how many.
        folder: for submitit's logs.
        parameters: of submitit, such as {"slurm_partition": "cpu", "timeout_min": 240}.
        cluster: "slurm", "local" or "debug"; by default SLURM where there is one, else local processes.

    Raises:
        ModuleNotFoundError: submitit is not installed.
        UsageError: a parameter is none of submitit's.
        KeyboardInterrupt: after the jobs were cancelled.
    """
    submitit = optional("submitit", "The executor submitit")

    executor = submitit.AutoExecutor(folder=folder, cluster=cluster)
    try:
        executor.update_parameters(**{"cpus_per_task": 1, "timeout_min": 24 * 60, "name": "rumi"} | parameters)
    except (NameError, TypeError) as error:
        raise UsageError(f"--slurm: {error}") from error
    submitted = executor.map_array(_clustered, [errand] * jobs, range(jobs), [jobs] * jobs)
    try:
        _wait(errand, submitted)
    except BaseException:
        for job in submitted:
            with suppress(Exception):
                job.cancel()
        raise


def _clustered(errand: Errand, first: int, of: int) -> None:
    os.environ.update(_ONE_THREAD)
    work(errand, first, of)


def _wait(errand: Errand, submitted: Sequence[Any]) -> None:
    """Until all work is done or all jobs have ended; what went wrong with a job as a whole is raised."""
    records = Records(errand.path)
    while not all(job.done() for job in submitted):
        records.refresh()
        failed = failures(errand)
        if all(job.id in records.by_id or job.id in failed for job in errand.jobs):
            break
        time.sleep(PAUSE_S)
    for job in submitted:
        job.result()
