"""How long one decision takes: 20 candidates, 100 particles of the prior; seconds, the best of some.

python -m scripts.touch_times                  # every method, quasi-static
python -m scripts.touch_times --mujoco         # particles in MuJoCo as well
"""

import sys
import time
from dataclasses import dataclass

import torch
import tyro

from rumi.cli import script
from rumi.seeding import split
from rumi.tasks.grasp_table import clearance_table
from rumi.tasks.touch_box.agent import Toucher
from rumi.tasks.touch_box.build import make_path_push
from rumi.tasks.touch_box.planar_robot import PlanarRobot
from rumi.tasks.touch_box.scene import TouchTask
from rumi.tasks.touch_box.selection import METHODS
from rumi.tasks.touch_box.settings import TouchSettings
from scripts.reproduce.cells import table


@dataclass(frozen=True)
class Options:
    """What is timed.

    Attributes:
        rounds: how often.
        mujoco: time particles in MuJoCo too.
        methods: which.
    """

    rounds: int = 5
    mujoco: bool = False
    methods: tuple[str, ...] = tuple(METHODS)


def seconds(settings: TouchSettings, rounds: int) -> tuple[float, float]:
    """Wall and processor time of a decision, each the least."""
    task = TouchTask()
    table = clearance_table(task.half[0], task.opening_m, task.half[1])
    robot = PlanarRobot(task, table)
    toucher = Toucher(task, settings, robot, table, make_path_push(settings.push_model, task))
    belief = toucher.filter.initial(1, settings.count, generator=split(0, "times"))
    found = []
    for index in range(rounds + 1):  # the first compiles
        wall, busy = time.perf_counter(), time.process_time()
        toucher.decide(belief, generator=split(index, "times"))
        found.append((time.perf_counter() - wall, time.process_time() - busy))
    return min(one for one, _ in found[1:]), min(two for _, two in found[1:])


def main() -> None:
    """Print the table."""
    options = tyro.cli(Options, description=__doc__)
    sys.stdout.write(f"{torch.get_num_threads()} threads, best of {options.rounds}: wall s (processor s)\n\n")
    rows = []
    for method in options.methods:
        cells = ["{:.3f} ({:.3f})".format(*seconds(TouchSettings(method=method), options.rounds))]
        if options.mujoco:
            cells.append("{:.1f} ({:.1f})".format(*seconds(TouchSettings(method=method, push_model="mujoco"), 1)))
        rows.append([method, *cells])
    sys.stdout.write(table(("method", "quasi-static", "MuJoCo")[: 2 + options.mujoco], rows))


if __name__ == "__main__":
    script(main)
