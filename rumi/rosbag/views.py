"""Views of a recording's cameras: clouds and depth images as surface points of the object and free points about it."""

from dataclasses import asdict, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.rosbag.frames import FrameTree
from rumi.rosbag.mapping import BagMap
from rumi.rosbag.streams import color_of, lens_of, lenses_of, role_of, unit_of
from rumi.rosbag.torques import BodyTrack
from sensors.log.reader import Log, Sample, Stream
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics
from sensors.vision.cloud import cloud_observation
from sensors.vision.persistence import Persistence
from sensors.vision.robot_body import RobotBody
from sensors.vision.view import Image, KnownScene, View, ViewSettings, view_observation

_APART_NS = 10**8  # between a depth image and the colour image that is of the same moment


class Views:
    """Clouds and depth images of a log, by time.

    Args:
        log: with raw streams.
        mapping: what they mean.
        frames: where the cameras were.
        generator: of the fit of planes.

    Attributes:
        any: whether there are any.
        problems: what could not be used.
    """

    def __init__(self, log: Log, mapping: BagMap, frames: FrameTree, generator: torch.Generator) -> None:
        self._mapping, self._frames, self._generator = mapping, frames, generator
        self._within = torch.tensor(mapping.scene.within)
        self._settings = ViewSettings(**asdict(mapping.view))
        tool = mapping.tool.links() if mapping.scene.tool_seen else ()
        self._tool = RobotBody(tool)
        self._robot: BodyTrack | None = None
        if mapping.robot is not None and mapping.robot.remove:
            self._robot = BodyTrack(mapping.robot, log, mapping, frames)
            self._settings = replace(self._settings, body_margin_m=mapping.robot.margin_m)
        self._streams: list[Stream] = []
        self._lenses = lenses_of(log, mapping)
        self._colors: list[Stream] = []
        self.problems: list[str] = []
        for stream in log.streams.values():
            role = role_of(stream, mapping)
            if role in ("cloud", "depth"):
                self._streams.append(stream)
            elif role == "color":
                self._colors.append(stream)
        self.any = any(len(stream) for stream in self._streams)

    def between(self, begin_ns: int, end_ns: int, *, last: bool = False) -> Observation:
        """What each camera saw of the object in a span of time: in the first picture that shows it, or in the last.

        Where pixels must persist (`view.persist_s`), pictures are taken in one after the other: up to the first that
        shows enough of them, or all.
        """
        found = [Observation.empty()]
        for stream in self._streams:
            mine = stream.samples(begin_ns, end_ns)
            self.problems += stream.problems
            memory: Persistence | None = None
            latest: Observation | None = None
            for one in reversed(mine) if last and self._settings.persist_s == 0 else mine:
                view = self._view(stream, one, memory)
                if view is None:
                    continue
                memory = view.memory
                if bool(view.observation.of_class(Semantics.SURFACE).any()):
                    latest = view.observation
                    if not last or self._settings.persist_s == 0:
                        break
            if latest is not None:
                found.append(latest)
        return concatenate(found)

    def _view(self, stream: Stream, sample: Sample, memory: Persistence | None) -> View | None:
        pose, known = self._frames.at(stream.frame, [sample.stamp_ns])
        if not bool(known.all()):
            self.problems.append(
                f"stream {stream.name}: the pose of {stream.frame!r} is not known at {sample.stamp_ns}"
            )
            return None
        try:
            scene = KnownScene(None, *self._body(sample.stamp_ns), self._within, self._within)
            if stream.kind == "points":
                return self._cloud(sample, pose[0].float(), scene, memory)
            return self._depth(stream, sample, pose[0].float(), scene, memory)
        except UsageError:
            raise
        except ValueError as error:
            self.problems.append(f"stream {stream.name}: a picture is left out: {error}")
            return None

    def _body(self, stamp_ns: int) -> tuple[RobotBody | None, Tensor | None]:
        """The robot's links, and their poses at a time; None where no link is known."""
        links, poses = list(self._tool.links), [torch.zeros(0, 4, 4)]
        if links:
            tool, known = self._frames.at(self._mapping.frames.tool, [stamp_ns])
            if not bool(known.all()):
                raise ValueError(f"where the tool was at {stamp_ns} is not known")
            poses.append(tool.float().expand(len(links), 4, 4))
        if self._robot is not None:
            links += self._robot.body.links
            poses.append(self._robot.at(stamp_ns))
        return (RobotBody(links), torch.cat(poses)) if links else (None, None)

    def _cloud(
        self, sample: Sample, world_T_camera: Float[Tensor, "4 4"], scene: KnownScene, memory: Persistence | None
    ) -> View:
        points = torch.tensor(sample.values["points"])
        color = sample.values["color"]
        colors = None if color is None else torch.tensor(color)
        if points.shape[0] == 1:
            points = points[0]
            colors = None if colors is None else colors[0]
        return cloud_observation(
            points,
            world_T_camera,
            self._settings,
            scene,
            colors=colors,
            stamp=sample.stamp_ns / 1e9,
            memory=memory,
            generator=self._generator,
        )

    def _depth(
        self,
        stream: Stream,
        sample: Sample,
        world_T_camera: Float[Tensor, "4 4"],
        scene: KnownScene,
        memory: Persistence | None,
    ) -> View:
        lens = lens_of(stream, self._lenses, self._mapping)
        depth = sample.values["depth"]
        assert depth is not None
        settings = replace(self._settings, unit=unit_of(stream), distortion=lens.distortion)
        color = self._color(stream, sample)
        image = Image(np.asarray(depth), lens.intrinsics, color, stamp=sample.stamp_ns / 1e9)
        return view_observation(image, world_T_camera, settings, scene, memory=memory, generator=self._generator)

    def _color(self, stream: Stream, sample: Sample) -> Tensor | None:
        """The colour image of its pixels that is nearest in time, if colours are asked for."""
        if self._settings.segmentation != "color":
            return None
        colors = color_of(stream, self._colors, self._mapping)
        at = sample.stamp_ns
        near = [] if colors is None else colors.samples(at - _APART_NS, at + _APART_NS)
        if not near:
            return None
        return torch.tensor(min(near, key=lambda one: abs(one.stamp_ns - at)).values["color"])
