"""Your own robot: put it in the place of `Robot`, your object in that of the mug, and run this.

    python scripts/own_robot.py                      # finds the mug, keeps the run in runs/own-robot
    python scripts/own_robot.py --motion trajectory  # the same robot without the tracker of the object
    rumi plot runs/own-robot

The page scripts/docs/how-to/own-robot.md goes through it. It needs no simulator.
"""

from functools import partial
from pathlib import Path

import torch
import tyro
from torch import Tensor

import rumi
from rumi.belief.motion import Motion
from rumi.cli import script
from rumi.records import RunResult, StepRecord
from rumi.robot.gripper import GripperShape
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.scenes import large_handled_mug
from sdf import se3
from sensors.touch.touch_readings import TouchReadings
from sensors.vision.camera import look_at, pinhole, pixel_rays
from sensors.vision.view import Image, KnownScene, ViewSettings, view_observation

BOUNDS = torch.tensor([[0.20, -0.30, 0.045], [0.80, 0.30, 0.045]])  # where the tool may be, at one height
WITHIN = torch.tensor([[0.40, -0.15, 0.0], [0.75, 0.20, 0.15]])  # holds the object
START = (0.25, 0.0, 0.0)  # (x, y, yaw) of the tool, out of the camera's way


class Robot:
    """A `rumi.Task`, all of it made up: a camera, a gripper that moves where it is told, and a mug that gives way."""

    def __init__(self, agent: Rummager, world_T_object: Tensor) -> None:
        self.agent, self.tool, self.model, self.truth = agent, agent.tool, agent.model, world_T_object
        self.tracked = agent.filter.settings.motion == "measured"
        self.pads, self.body = self.tool.shape.pad_shell(0.003).float(), self.tool.shape.solid(0.004).float()
        self.readings = TouchReadings(self.body, WITHIN)
        self.at = torch.tensor(START)

    def reset(self, seed: int) -> rumi.Reading:
        """Look, from where the tool is out of the way."""
        camera = look_at(torch.tensor([-0.05, 0.0, 0.40]), torch.tensor([0.55, 0.03, 0.02]))
        intrinsics = pinhole(120, 160, 0.8)
        random = torch.Generator().manual_seed(seed)
        depth = self.depth(camera, intrinsics) + 0.001 * torch.randn(120, 160, generator=random)
        seeing, scene = ViewSettings(segmentation="plane", unit=1.0), KnownScene(within=WITHIN, bounds=WITHIN)
        seen = view_observation(Image(depth.numpy(), intrinsics), camera, seeing, scene, generator=random)
        return self.readings.first(seen.observation, self.tool.pose(self.at))

    def step(self, control: Tensor) -> rumi.Reading:
        """Go along the control's path; what is met gives way."""
        path = self.tool.free_path(self.at, control[None].clamp(-1.0, 1.0), 20)
        before, felt, motion = self.truth, [], []
        for self.at in path:
            pose = self.tool.pose(self.at)
            for _ in range(20):  # the object goes out of the way by as much as the tool is in it
                body = se3.apply(se3.inverse(self.truth) @ pose, self.body)
                depth = self.model.exact.distance(body)
                deepest = int(depth.argmin())
                if depth[deepest] > -1e-4:
                    break
                way = self.truth[:3, :3] @ self.model.exact(body[deepest])[1] * torch.tensor([1.0, 1.0, 0.0])
                shift = depth[deepest] * way / way.square().sum().clamp_min(0.1)
                self.truth = se3.make(self.truth[:3, :3], self.truth[:3, 3] + shift)
            pads = se3.apply(pose, self.pads)
            felt.append(pads[self.model.exact.distance(se3.apply(se3.inverse(self.truth), pads)) < 0.001])
            motion.append(self.truth @ se3.inverse(before))
        measured = torch.stack(motion) if self.tracked else None
        return self.readings.reading(self.tool.pose(path), felt, measured)

    def finish(self, action: object) -> None:
        """Nothing is done at the end."""

    def close(self) -> None:
        """Nothing to let go of: a driver may have a connection to close."""

    def depth(self, camera: Tensor, intrinsics: Tensor) -> Tensor:
        """Metres to what each pixel shows, infinite where that is nothing near."""
        rays, depth = pixel_rays(120, 160, intrinsics).reshape(-1, 3) @ camera[:3, :3].T, torch.zeros(120 * 160)
        for _ in range(60):  # each ray goes on by its distance to the nearest surface
            points = camera[:3, 3] + depth[:, None] * rays
            mug = self.model.exact.distance(se3.apply(se3.inverse(self.truth), points))
            depth = depth + torch.minimum(mug, points[:, 2]) / rays.norm(dim=-1)
        return torch.where(depth > 2.0, torch.inf, depth).reshape(120, 160)


def robot_for(motion: Motion = "measured") -> Robot:
    """The robot, and in `Robot.agent` what finds the mug with it."""
    model = large_handled_mug()  # of a mesh: rumi.tasks.rummage.objects.own_model(ObjectSettings(mesh="part.stl"))
    workspace = rumi.Workspace.from_bounds(BOUNDS, 0.01, planar_height=float(BOUNDS[0, 2]))
    agent = rumi.rummager(model, workspace, tool=GripperShape(), motion=motion)
    return Robot(agent, se3.from_planar(torch.tensor([0.56, 0.03, 0.7]), float(-model.exact.bounds[0, 2])))


def main(
    out: Path = Path("runs/own-robot"), *, motion: Motion = "measured", seed: int = 0
) -> tuple[RunResult, list[StepRecord], Robot]:
    """Find the mug until sure, and keep the run.

    Args:
        out: folder of the run.
        motion: how the object's motion is known.
        seed: of all randomness.
    """
    robot, steps = robot_for(motion), list[StepRecord]()
    result = rumi.run(robot, robot.agent, seed=seed, steps=30, folder=out, on_step=steps.append)
    off_mm = 1e3 * float((steps[-1].belief.mode()[:2, 3] - robot.truth[:2, 3]).norm())
    print(f"{result.stopped_by} after {result.steps} actions, {off_mm:.1f} mm off")
    return result, steps, robot


if __name__ == "__main__":
    script(partial(tyro.cli, main, description=__doc__))
