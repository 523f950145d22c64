"""An update of the belief over trajectories after an action that touched the object."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from rumi.belief.pose_filter import FilterSettings
from rumi.belief.pose_trajectories import NOISE, PHYSICS, Trajectories
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.pushed_object import PushedObject
from rumi.belief.trajectory_history import History, Segment
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.bench.case import Case, Setup, case
from rumi.bench.drawn_segments import drawn_push, drawn_truth, drawn_view
from rumi.bench.scenes import HEIGHT_M, mug_scene
from rumi.robot.gripper import GripperShape
from rumi.seeding import normal, split
from sensors.discrepancy import Discrepancy

_SEGMENTS = 3  # of the timed action


@case("trajectory_update", host=True)
def trajectory_update(setup: Setup) -> Case:
    """Update by trajectories."""
    sdf = mug_scene(setup).model.sdf
    resting = -float(sdf.bounds[0, 2])
    fine, spacing = 0.006 if setup.tiny else 0.0025, PoseTrajectorySettings().tool_spacing_m
    model = PushedObject.of(
        sdf, GripperShape(), height_m=HEIGHT_M, resting_m=resting, spacing_m=spacing, pad_spacing_m=fine
    )
    count = setup.size(150, 8)
    settings = FilterSettings(motion="trajectory")
    own = replace(settings.trajectories, particles=count).for_mugs()
    settings = replace(settings, trajectories=own)
    followed = PoseTrajectoryFilter(settings, Discrepancy(sdf, 0.08, free_scale=80.0, tolerance=0.001), model)
    random = split(0, "bench/trajectories")
    now, new = _belief(followed, model, setup.size(6, 1), setup.size(50, 6), random)
    flat = torch.zeros(count, dtype=torch.float64).log_softmax(-1)

    def run() -> Tensor:
        held, draws = now, torch.Generator().manual_seed(0)
        for k, segment in enumerate(new):
            held = followed.absorbed(held, flat, segment, draws, opens=k == 0, closes=k == _SEGMENTS - 1)
        return held.pose

    return Case(
        f"update by trajectories: {count} particles, {len(now.history)} segments, {_SEGMENTS} new ones",
        setup.ours(run)[-1:],  # the plain version takes a thousand times as long
        otherwise=setup.versions[-1],
        remarks=("the belief's part alone, on readings drawn from the model",),
    )


def _belief(
    followed: PoseTrajectoryFilter, model: PushedObject, actions: int, pads: int, random: torch.Generator
) -> tuple[Trajectories, list[Segment]]:
    """Particles after a view and some actions, and the segments of one more."""
    own = followed.own
    pose = torch.zeros(3, dtype=torch.float64)
    truth = drawn_truth(pose, random)
    places = model.pads[torch.linspace(0, len(model.pads) - 1, pads).long()]
    places = torch.cat((places[:, :2], places[:, 2:] + HEIGHT_M - model.resting_m), -1)
    view = drawn_view(model, own, pose, 4 * pads, random)
    view = view._replace(weight=torch.full_like(view.weight, own.seen_points / len(view.points)))
    start = torch.randn(own.particles, 3, generator=random, dtype=torch.float64) * pose.new_tensor((1e-3, 1e-3, 0.02))
    physics = normal((own.particles, PHYSICS), generator=random, dtype=torch.float64)
    noise = normal((own.particles, 1, NOISE), generator=random, dtype=torch.float64)
    now = Trajectories(
        physics,
        noise,
        start[:, None].repeat(1, 2, 1),
        start.new_zeros(own.particles, 1),
        History.empty().appended(view),
        start,
    )
    now = now.replayed(model, own, now.history, torch.zeros(own.particles, dtype=torch.long))
    flat = start.new_zeros(own.particles).log_softmax(-1)
    new: list[Segment] = []
    for action in range(actions + 1):
        new, angle = [], 2.4 * action
        reach = model.outline.radius + 0.035
        way = pose.new_tensor((math.cos(angle), math.sin(angle)))
        for _ in range(_SEGMENTS):
            back = torch.linspace(reach, reach - 0.015, own.instants + 1, dtype=torch.float64)[:, None]
            reach -= 0.015
            middle = truth.pose[0, :2]
            tool = torch.cat((middle - back * way, torch.full_like(back, angle)), -1)
            segment, truth = drawn_push(model, own, truth, torch.stack((tool[:-1], tool[1:]), 1), places, random)
            new.append(segment._replace(weight=torch.full_like(segment.weight, 4 * own.pad_weight)))
        if action < actions:
            for k, segment in enumerate(new):
                now = followed.absorbed(now, flat, segment, random, opens=k == 0, closes=k == _SEGMENTS - 1)
    return now, new
