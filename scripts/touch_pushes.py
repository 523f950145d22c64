"""How far push models are off over one poke of the box, against the simulator, its pose known.

python -m scripts.touch_pushes --pokes 60
"""

import math
import sys
from dataclasses import dataclass

import torch
import tyro
from torch import Tensor

from rumi.cli import script
from rumi.dynamics.registry import PUSH_MODELS
from rumi.dynamics.sliding import Sliding
from rumi.seeding import split
from rumi.tasks.touch_box.build import make_path_push
from rumi.tasks.touch_box.gripper_robot import GripperRobot
from rumi.tasks.touch_box.scene import TouchTask, draw_truth
from scripts.reproduce.cells import push_errors


@dataclass(frozen=True)
class Options:
    """What is poked.

    Attributes:
        pokes: how many, 0.2 m each, from all sides, to about the box's middle.
        lever: c of the limit surface, as a multiple of that of even pressure.
        seed: of boxes and pokes.
    """

    pokes: int = 60
    lever: float = 1.8
    seed: int = 2000


def poke(pose: Tensor, generator: torch.Generator) -> Tensor:
    """A straight path (41, 3) that ends near the middle of a box."""
    angle = 2.0 * math.pi * float(torch.rand((), generator=generator))
    way = torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
    end = pose[:2] + 0.02 * torch.randn(2, generator=generator, dtype=torch.float64)
    share = torch.linspace(-1.0, 0.0, 41, dtype=torch.float64)[:, None]
    return torch.cat((end + 0.2 * share * way, torch.full((41, 1), angle, dtype=torch.float64)), 1)


def main() -> None:
    """Print the table."""
    options = tyro.cli(Options, description=__doc__)
    task, generator = TouchTask(), split(options.seed, "pokes")
    robot = GripperRobot(task)
    carriers = {name: make_path_push(name, task) for name in PUSH_MODELS}
    errors: dict[str, list[Tensor]] = {"stays": [], **{name: [] for name in carriers}}
    for index in range(options.pokes):
        truth = draw_truth(task, options.seed + index)
        robot.reset(truth, index)
        touched = robot.execute(poke(truth.pose, generator), lambda so_far: True)
        if touched.blocked:
            continue
        after, lever = robot.box_pose(), torch.tensor(options.lever * task.even_lever_m, dtype=torch.float64)
        own = Sliding(torch.zeros(2, dtype=torch.float64), lever, torch.tensor(truth.friction, dtype=torch.float64))
        errors["stays"].append(truth.pose - after)
        for name, carrier in carriers.items():
            found = carrier(truth.pose[None], touched.path[None], robot.pusher, task.outline, own)
            errors[name].append(found.track[0, -1] - after)
    apart = {name: torch.stack(each) for name, each in errors.items()}
    found = {name: (each[:, :2].norm(dim=-1), each[:, 2]) for name, each in apart.items()}
    sys.stdout.write(push_errors(found))


if __name__ == "__main__":
    script(main)
