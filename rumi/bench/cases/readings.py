"""A filter's update by one reading, at the rate of a controller: in contact and free."""

import statistics
import time
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.pushed_pose import PushedPoseFilter
from rumi.belief.pushed_pose_reading import PushedPoseBelief
from rumi.bench.case import Case, Setup, Variant, cases
from rumi.bench.scenes import HEIGHT_M, mug_scene
from rumi.dynamics.along_path import push_along_path
from rumi.dynamics.push_parameters import sliding_of
from rumi.dynamics.pushed_body import PushedBody
from rumi.garbage import set_aside
from rumi.robot.gripper import GripperShape
from rumi.seeding import split

_SPEED_M = 2e-4  # of the tool from one reading to the next: 0.2 m/s at 1 kHz
_READINGS = 500  # of an episode
_EPISODES = 200  # 100 000 readings; a quick run has a tenth
_NOISE = (1e-3, 1e-3, 0.0175)


@cases({"reading-contact": ("in contact", 0.01), "reading-free": ("free", 1.0)}, slow=True, host=True)
def reading(setup: Setup, what: str, aside_m: float) -> Case:
    """A tool that passes by an object `aside_m` beside its middle."""
    scene = mug_scene(setup)
    body = PushedBody.of(scene.model.sdf, HEIGHT_M, GripperShape())
    filter_ = PushedPoseFilter(body)
    path, readings = _episode(filter_, setup.size(_READINGS, 5), aside_m)

    def run(timed: Callable[[float], None] | None = None) -> Tensor:
        random = split(1, "bench/readings")
        belief: PushedPoseBelief = filter_.initial(readings[0], generator=random)
        for index, read in enumerate(readings[1:]):
            start = time.thread_time()
            belief = filter_.step(belief, path[index : index + 2], read, generator=random)
            if timed is not None:
                timed(time.thread_time() - start)
        return belief.mean()

    run()  # which loads what is compiled
    seconds: list[float] = []
    with set_aside():
        for _ in range(setup.size(_EPISODES // 10 if setup.quick else _EPISODES, 1)):
            run(seconds.append)
    ranks = statistics.quantiles(seconds, n=1000, method="inclusive")
    facts = {
        f"p{100 * share:g}, CPU ms": round(1e3 * ranks[round(1000 * share) - 1], 3) for share in (0.5, 0.99, 0.999)
    }
    return Case(
        f"an update by a reading, {what}: {filter_.settings.particles} particles",
        (Variant(setup.versions[-1], run, version=setup.versions[-1]),),
        otherwise=setup.versions[-1],
        items=len(readings) - 1,
        item="reading",
        facts=facts | {"longest, CPU ms": round(1e3 * max(seconds), 3), "readings": len(seconds)},
        rounds=3,
    )


def _episode(
    filter_: PushedPoseFilter, count: int, aside_m: float
) -> tuple[Float[Tensor, "K 3"], Float[Tensor, "K 3"]]:
    """The tool's path, which begins before the object, and noisy readings of the object's pose."""
    body, way = filter_.body, _SPEED_M * torch.arange(count, dtype=torch.float64)
    start = -body.pusher.radius - body.outline.radius
    path = torch.stack((start + way, torch.full_like(way, aside_m), torch.zeros_like(way)), -1)
    sliding = sliding_of(torch.tensor([filter_.prior.mean], dtype=torch.float64), body.support)
    track = push_along_path(torch.zeros(1, 3).double(), path[None], body.pusher, body.outline, sliding).track[0]
    poses = torch.cat((torch.zeros(1, 3).double(), track))
    noise = torch.randn(poses.shape, generator=split(0, "bench/readings"), dtype=torch.float64)
    return path, poses + poses.new_tensor(_NOISE) * noise
