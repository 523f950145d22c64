"""Your own robot: put your driver in the place of `FakeDriver`, your numbers into own_robot.toml, and run this.

    python scripts/own_robot.py --out own       # rummages, and leaves own/log.h5
    rumi check own/log.h5                       # the camera's points over the model: is the calibration right?
    rumi replay own/log.h5                      # the belief again, from the raw streams

The page scripts/docs/own-robot.md goes through it step by step.
"""

import argparse
import math
import time
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from rumi import loop
from rumi.cli import script
from rumi.errors import UsageError
from rumi.records import RunResult, StepRecord
from rumi.robot.gripper import GripperShape
from rumi.robot.tool import Tool
from rumi.rosbag.mapping import BagMap, read_mapping
from rumi.rosbag.scene import rummager_of_map, settings_of
from rumi.runs.folder import prepare_folder
from rumi.runs.logbook import LOG
from rumi.runs.replay import digest
from rumi.task import StepResult
from rumi.tasks.rummage.scenes import large_handled_mug
from sdf import se3
from sensors.log.writer import LogWriter, StreamSpec
from sensors.observation import Observation
from sensors.reading import Reading
from sensors.semantics import Semantics
from sensors.touch.tactile import InstantPoints, swept_points, tactile_observation
from sensors.vision.camera import look_at, pinhole, pixel_rays
from sensors.vision.view import Image, KnownScene, ViewSettings, view_observation

STREAMS = [
    StreamSpec("depth", "depth16", "camera", {"topic": "depth", "unit_m": 0.001, "camera": "camera"}),
    StreamSpec("camera", "camera", "camera", {"topic": "camera"}),
    StreamSpec("felt", "points", "gripper", {"topic": "felt"}),
    StreamSpec("tf/base/gripper", "pose", "base", {"parent": "base", "child": "gripper"}),
    StreamSpec("tf/base/camera", "pose", "base", {"parent": "base", "child": "camera", "static": True}),
]


class Moment(NamedTuple):
    """What a driver reports at one instant of a motion.

    Attributes:
        stamp_ns: when.
        world_T_tool: (4, 4), from the measured joints.
        felt_t: (n, 3), points of the fingers that feel something, tool frame, metres.
    """

    stamp_ns: int
    world_T_tool: Tensor
    felt_t: Tensor


class Driver(Protocol):
    """What you write for your robot; metres, radians, ns since 1970."""

    intrinsics: Tensor  # (3, 3)
    world_T_camera: Tensor  # (4, 4): z forward, x right, y down

    def home(self) -> Moment:
        """Go to where the camera sees the object, and stay there."""
        ...

    def depth(self) -> tuple[int, np.ndarray]:
        """A depth image (H, W) in millimetres, 0 where unknown, and its stamp."""
        ...

    def follow(self, path: Tensor) -> list[Moment]:
        """Go along configurations (K, 3): x, y, yaw; stop where force is felt. One moment for each of them."""
        ...


class FakeDriver:
    """A mug that is screwed to the table, a camera with noise, and fingers that stop where they touch."""

    def __init__(self, world_T_mug: Tensor, *, noise_m: float = 0.001, camera_off_m: float = 0.0) -> None:
        if not math.isfinite(camera_off_m):
            raise UsageError(f"Expected --camera-off in metres, got {camera_off_m}")
        self.world_T_mug, self._noise_m = world_T_mug, noise_m
        self._mug, self._generator = large_handled_mug().exact, torch.Generator().manual_seed(0)
        self._tool = Tool(torch.tensor([[0.0, -0.5], [1.0, 0.5]]), height_m=0.045)
        shape = GripperShape()
        self._pads, self._body = shape.pad_shell(0.0025).float(), shape.solid(0.004).float()
        self.intrinsics = pinhole(120, 160, 0.8)
        self._eye = look_at(torch.tensor([-0.05, 0.0, 0.40]), torch.tensor([0.55, 0.03, 0.02]))
        # what the calibration says is not quite where the camera is
        self.world_T_camera = self._eye.clone()
        self.world_T_camera[0, 3] += camera_off_m
        self._at, self._clock = torch.tensor([0.2, 0.0, 0.0]), time.time_ns()

    def home(self) -> Moment:
        """See `Driver`."""
        self._at = torch.tensor([0.2, 0.0, 0.0])
        return self._moment(0.15)

    def depth(self) -> tuple[int, np.ndarray]:
        """See `Driver`."""
        rays = pixel_rays(120, 160, self.intrinsics).reshape(-1, 3) @ self._eye[:3, :3].T
        origin, depth = self._eye[:3, 3], torch.zeros(len(rays))
        for _ in range(60):  # each ray goes on by its distance to the nearest surface
            points = origin + depth[:, None] * rays
            depth = depth + torch.minimum(self._distance(points), points[:, 2]) / rays.norm(dim=-1)
        depth += self._noise_m * torch.randn(depth.shape, generator=self._generator)
        unknown = depth > 2.0
        self._clock += int(0.05e9)
        millimetres = (1000.0 * depth.masked_fill(unknown, 0.0)).round().reshape(120, 160)
        return self._clock, millimetres.numpy().astype(np.uint16)

    def follow(self, path: Tensor) -> list[Moment]:
        """See `Driver`."""
        moments, blocked = [], False
        for goal in path:
            start = self._at
            parts = torch.linspace(0.0, 1.0, 9)[:, None]
            ways = start + parts * (goal - start)
            clear = self._gap(ways) > 0.0005
            free = int(clear.to(torch.uint8).cumprod(0).sum())
            if not blocked:
                self._at = ways[max(free - 1, 0)]
            blocked |= free < len(ways)
            moments.append(self._moment(1.0 / len(path)))
        return moments

    def _moment(self, seconds: float) -> Moment:
        self._clock += int(1e9 * seconds)
        pose = self._tool.pose(self._at)
        near = self._distance(se3.apply(pose, self._pads)) < 0.003
        return Moment(self._clock, pose, self._pads[near])

    def _gap(self, configurations: Tensor) -> Tensor:
        return self._distance(se3.apply(self._tool.pose(configurations), self._body)).amin(-1)

    def _distance(self, points: Tensor) -> Tensor:
        return self._mug.distance(se3.apply(se3.inverse(self.world_T_mug), points)).to(points)


class OwnRobot:
    """A `rumi.task.Task`: turns what the driver reports into readings, and writes it down."""

    def __init__(self, driver: Driver, mapping: BagMap, log: LogWriter) -> None:
        self.driver, self.mapping, self.log = driver, mapping, log
        self.tool: Tool | None = None
        self._within = torch.tensor(mapping.scene.within)
        self._body = GripperShape().solid(0.005).float()
        self._start_ns = 0

    def reset(self, seed: int) -> StepResult:
        """Look from where the tool is out of the way."""
        now = self.driver.home()
        stamp_ns, image = self.driver.depth()
        self._start_ns = now.stamp_ns
        self._note(now)
        self.log.append("depth", stamp_ns, stamp_ns, depth=image)
        size = np.array(image.shape, np.int32)
        intrinsics = self.driver.intrinsics.numpy()
        self.log.append("camera", stamp_ns, stamp_ns, intrinsics=intrinsics, distortion=np.zeros(0), size=size)
        pose = self.driver.world_T_camera.numpy()
        self.log.append("tf/base/camera", stamp_ns, stamp_ns, pose=pose)
        now = self.driver.home()  # it is there: the end of the first view
        self._note(now)
        view = view_observation(
            Image(image, self.driver.intrinsics),
            self.driver.world_T_camera,
            ViewSettings(segmentation="plane"),
            KnownScene(within=self._within, bounds=self._within),
            generator=torch.Generator().manual_seed(seed),
        )
        seen = view.observation
        return self._result(seen, torch.zeros(len(seen), dtype=torch.long), [now])

    def step(self, control: Tensor) -> StepResult:
        """Carry out one control, and report what was felt and what was free."""
        assert self.tool is not None
        path = self.tool.free_path(self._at, control[None].clamp(-1.0, 1.0), self.mapping.actions.instants)
        moments = self.driver.follow(path)
        for moment in moments:
            self._note(moment)
        poses = torch.stack([moment.world_T_tool for moment in moments])
        felt = [se3.apply(moment.world_T_tool, moment.felt_t) for moment in moments]
        counts = torch.tensor([len(points) for points in felt])
        touched = InstantPoints(torch.cat(felt), torch.arange(len(felt)).repeat_interleave(counts))
        # the object may have moved at each touch: what was free before it is kept apart from what was after it
        group = (counts > 0).long().cumsum(0)
        free, _ = swept_points(poses, self._body, 0.005, group=group, region=self._within)
        if len(touched.points):
            apart = torch.cdist(free.points, touched.points).amin(-1) > self.mapping.scene.clear_m
            free = InstantPoints(free.points[apart], free.instant[apart])
        observation, instant = tactile_observation(touched, free)
        return self._result(observation, instant, moments)

    def finish(self, action: object) -> None:
        """Nothing is done at the end."""

    def close(self) -> None:
        """Nothing to let go of here: a driver may have a connection to close."""

    def _note(self, moment: Moment) -> None:
        self.log.append("tf/base/gripper", moment.stamp_ns, moment.stamp_ns, pose=moment.world_T_tool.numpy())
        if len(moment.felt_t):
            self.log.append("felt", moment.stamp_ns, moment.stamp_ns, points=moment.felt_t[None].numpy())

    def _result(self, observation: Observation, instant: Tensor, moments: list[Moment]) -> StepResult:
        poses = torch.stack([moment.world_T_tool for moment in moments])
        self._at = se3.to_planar(poses[-1])
        in_contact = torch.tensor([len(moment.felt_t) > 0 for moment in moments])
        stamp = (moments[-1].stamp_ns - self._start_ns) / 1e9
        # no sensor measures how the object moves, and no arm refused anything
        reading = Reading(observation, instant, poses, in_contact, None, self._at, torch.zeros(()), stamp)
        return StepResult(reading)


def main(out: Path, driver: Driver, *, seed: int = 0) -> tuple[RunResult, StepRecord]:
    """Rummage with a driver until sure, and leave a log."""
    mapping = read_mapping(Path(__file__).with_suffix(".toml"))
    settings = settings_of(mapping)
    last: list[StepRecord] = []
    prepare_folder(out)
    if (out / LOG).exists():
        raise UsageError(f"{out} holds a log already: give another folder, or remove it")
    with LogWriter(out / LOG, STREAMS, about={"map": mapping.text}) as log:
        robot = OwnRobot(driver, mapping, log)
        rummager = rummager_of_map(mapping, settings, driver.home().world_T_tool[None, :3, 3])
        robot.tool = rummager.tool

        def on_step(step: StepRecord) -> None:
            log.reading(step.reading, control=step.control, digest=digest(step.belief))
            seen = int(step.reading.observation.of_class(Semantics.SURFACE).sum())
            x, y = step.belief.mode()[:2, 3].tolist()
            print(f"step {step.step}: {seen} points on it, near ({x:.3f}, {y:.3f}) m, expects {step.expected_nll:.1f}")
            last[:] = [step]

        result = loop.run(robot, rummager, seed=seed, steps=settings.steps or 12, on_step=on_step)
        log.finish(result.as_dict())
    print(f"{result.stopped_by} after {result.steps} actions")
    return result, last[0]


def command() -> None:
    """Rummage with the fake driver."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("own"), help="folder of the log")
    parser.add_argument("--camera-off", type=float, default=0.0, help="metres that the fake camera is off along x")
    asked = parser.parse_args()
    mug = se3.from_planar(torch.tensor([0.56, 0.03, 0.7]), float(-large_handled_mug().exact.bounds[0, 2]))
    main(asked.out, FakeDriver(mug, camera_off_m=asked.camera_off))


if __name__ == "__main__":
    script(command)
