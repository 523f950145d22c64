"""Recorded 1 kHz pushes replayed as they came: how long after each reading the belief has taken it in.

python -m scripts.reading_times run     # needs RUMI_DATA; as long as the runs took, 100 s
chrt -f 10 python -m scripts.reading_times run     # as a controller runs, before all else on the machine
python -m scripts.reading_times show

Every sample of `closed_loop.npz` moves the tip; the tracker's pose is new at every fourth or so, and only then a
reading. Normal noise of 1 mm and 1 degree is added to each new pose. A sample that comes while the one before is worked
on waits for it. "wall" is timed beside whatever else the machine does; "by its own time" is how long a sample would
have waited and been worked on had the filter had a core to itself: the same queue, by its thread's processor time.
"""

import os
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch

from rumi.belief.pushed_pose import PushedPoseFilter
from rumi.cli import script
from rumi.garbage import set_aside
from rumi.seeding import split
from scripts.bench import real_knocks
from scripts.bench.real_pushes import square_body
from scripts.experiment import Experiment, Line
from scripts.knocks import NOISE
from scripts.reproduce.cells import table
from sdf.threads import using

LATE_S = 0.01
_NAP_S = 2e-4  # before a sample is due the processor is not let go of: to be woken takes about as long


class Samples(NamedTuple):
    """What a controller gets at each instant.

    Attributes:
        time: (n), seconds from the first.
        tip: (n, 3), the tool's poses.
        pose: what the tracker says; None where it says nothing new.
    """

    time: np.ndarray
    tip: torch.Tensor
    pose: list[torch.Tensor | None]


class Times(NamedTuple):
    """Seconds of each sample.

    Attributes:
        own: of the filter's thread.
        wall: from when it was due until it was taken in.
    """

    own: np.ndarray
    wall: np.ndarray


def samples_of(run: real_knocks.Run, seed: int) -> Samples:
    """A run's samples, with the noise of a seed."""
    fresh = np.concatenate(([True], (np.diff(run.pose, axis=0) != 0).any(1)))
    noise = torch.randn((len(fresh), 3), generator=split(seed, f"reading times {run.name}"), dtype=torch.float64)
    poses = torch.tensor(run.pose) + torch.tensor(NOISE, dtype=torch.float64) * noise
    tip = torch.tensor(np.concatenate((run.tip, np.zeros((len(run.tip), 1))), 1))
    return Samples(run.time, tip, [pose if new else None for pose, new in zip(poses, fresh, strict=True)])


def replay(samples: Samples, seed: int) -> Times:
    """Take samples in at the pace at which they came."""
    random, own = split(seed, "reading times filter"), PushedPoseFilter(square_body())
    first = samples.pose[0]
    assert first is not None
    belief = own.initial(first, generator=random)
    spent, late = np.zeros(len(samples.time)), np.zeros(len(samples.time))
    began = time.perf_counter()
    for k in range(1, len(samples.time)):
        due = began + float(samples.time[k])
        if (left := due - time.perf_counter()) > _NAP_S:
            time.sleep(left - _NAP_S)
        while time.perf_counter() < due:
            pass
        start = time.thread_time()
        belief = own.step(belief, samples.tip[k - 1 : k + 1], samples.pose[k], generator=random)
        spent[k] = time.thread_time() - start
        late[k] = time.perf_counter() - due
    return Times(spent[1:], late[1:])


def queued(due: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Seconds from when each sample is due until it is taken in, by one who works on one after the other."""
    free, late = 0.0, np.empty(len(due))
    for k, (time_, work) in enumerate(zip(due.tolist(), own.tolist(), strict=True)):
        free = max(free, time_) + work
        late[k] = free - time_
    return late


def measure(runs: str, seed: int) -> dict[str, Any]:
    """Times of all samples of the recorded runs."""
    load, own, wall, alone, read = os.getloadavg()[0], [], [], [], 0
    with using(1, torch_too=True):
        for number, run in enumerate(real_knocks.runs().values()):
            samples = samples_of(run, seed)
            if number == 0:
                replay(
                    Samples(samples.time[:200], samples.tip[:200], samples.pose[:200]), seed
                )  # loads what is compiled
            with set_aside():
                found = replay(samples, seed)
            own.append(found.own)
            wall.append(found.wall)
            alone.append(queued(samples.time[1:], found.own))
            read += sum(pose is not None for pose in samples.pose[1:])
    kinds = {"own": own, "alone": alone, "wall": wall}
    joined = {kind: 1e3 * np.concatenate(parts) for kind, parts in kinds.items()}
    ranks = {kind: np.percentile(parts, (50, 99, 99.9, 100)).round(3).tolist() for kind, parts in joined.items()}
    prompt = os.sched_getscheduler(0) in (os.SCHED_FIFO, os.SCHED_RR)
    counts = {"samples": len(joined["own"]), "readings": read, "load": round(load, 1), "real_time_priority": prompt}
    return ranks | counts | {f"late_{kind}": int((joined[kind] > 1e3 * LATE_S).sum()) for kind in ("alone", "wall")}


def show(lines: list[Line], chosen: Mapping[str, tuple[Any, ...]]) -> str:
    """A row for each way to count."""
    names = {"own": "work alone", "alone": "to the answer, by its own time", "wall": "to the answer, wall"}
    rows = []
    for line in lines:
        head = f"{line['samples']} samples, {line['readings']} readings, load {line['load']}"
        head += ", real-time priority" * line["real_time_priority"]
        for kind, name in names.items():
            late = f"{line[f'late_{kind}']}" if kind != "own" else "-"
            rows.append([head, name, *(f"{value:.2f}" for value in line[kind]), late])
    return table(("runs", "ms of a sample", "p50", "p99", "p99.9", "longest", "over 10 ms"), rows)


EXPERIMENT = Experiment(__doc__, "reading_times.jsonl", {"runs": ("recorded",)}, measure, show, seeds="0")

if __name__ == "__main__":
    script(EXPERIMENT.main)
