"""What the sensors of a simulated robot gave, as raw streams for a log, and the mapping that reads them again."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from rumi.robot.gripper import GripperShape
from rumi.sim.bubble_camera import BubbleCamera
from rumi.sim.settings import SimSettings
from rumi.tasks.rummage.objects import OBJECTS, ObjectSettings
from rumi.tasks.rummage.scene_spec import TaskSpec
from sensors.vision.camera import pinhole

_BUBBLES = ("left", "right")
_GROWN_M = 0.15  # about the region of the first view, which the object may be pushed out of
_START_NS = 1_700_000_000 * 10**9

Sink = Callable[[str, int, Mapping[str, object]], object]


class RawStreams:
    """Hands a task's images and poses on as they come, at stamps of a clock that runs on while the camera looks.

    Args:
        spec: the task.
        settings: of the simulator.
        shape: the gripper's.
        bubbles: their cameras.
        look_frames: pictures of one look of the camera, the first one perhaps apart.

    Attributes:
        sink: what takes a stream's name, a stamp in ns, and the columns of a row; None while nobody listens.
    """

    def __init__(
        self,
        spec: TaskSpec,
        settings: SimSettings,
        shape: GripperShape,
        bubbles: Sequence[BubbleCamera],
        look_frames: int,
    ) -> None:
        self.sink: Sink | None = None
        self._spec, self._settings, self._shape, self._bubbles = spec, settings, shape, tuple(bubbles)
        self._rate = settings.sensors.frame_rate_hz
        self._mini_ns = round(1e6 * settings.action_s / settings.mini_steps) * 1000
        self._look_steps = self._first_steps = self._steps_of(look_frames)
        self._now = _START_NS
        self._region = torch.zeros(2, 3)

    def kinds(self) -> dict[str, tuple[str, str, dict[str, Any]]]:
        """Kind, frame and further attributes of the streams, by name."""
        found: dict[str, tuple[str, str, dict[str, Any]]] = {
            "camera/depth": ("depth", "camera", {"topic": "/camera/depth", "role": "depth", "camera": "camera/info"}),
            "camera/color": ("color", "camera", {"topic": "/camera/color", "role": "color"}),
            "camera/info": ("camera", "camera", {"topic": "/camera/info", "role": "camera"}),
            "tf/world/camera": ("pose", "world", _frames("world", "camera", static=True)),
            "tf/world/tool": ("pose", "world", _frames("world", "tool", static=False)),
        }
        for name, _ in zip(_BUBBLES, self._bubbles, strict=False):
            about = {"topic": f"/{name}/depth", "role": "bubble", "camera": f"{name}/info"}
            found[f"{name}/depth"] = ("depth", name, about)
            found[f"{name}/info"] = ("camera", name, {"topic": f"/{name}/info", "role": "camera"})
            found[f"tf/tool/{name}"] = ("pose", "tool", _frames("tool", name, static=True))
        return found

    def start(
        self,
        world_T_camera: Float[Tensor, "4 4"],
        world_T_tool: Float[Tensor, "4 4"],
        rest: Sequence[Float[Tensor, "H W"]],
        tool_T_bubbles: Sequence[Float[Tensor, "4 4"]],
    ) -> None:
        """What is told once: where the cameras are taken to be, their lenses, and the membranes at rest."""
        camera = self._spec.camera
        assert camera is not None
        self._now = _START_NS
        self._put("tf/world/camera", self._now, pose=world_T_camera)
        intrinsics = pinhole(camera.height, camera.width, camera.field_of_view_rad)
        self._lens("camera/info", intrinsics, (camera.height, camera.width))
        self._put("tf/world/tool", self._now, pose=world_T_tool)
        for name, bubble, image, pose in zip(_BUBBLES, self._bubbles, rest, tool_T_bubbles, strict=False):
            self._put(f"tf/tool/{name}", self._now, pose=pose)
            self._lens(f"{name}/info", bubble.intrinsics, tuple(image.shape))
            self._put(f"{name}/depth", self._now, depth=image)

    def frame(
        self,
        index: int,
        depth: Float[Tensor, "H W"] | None,
        color: UInt8[Tensor, "H W 3"],
        world_T_tool: Float[Tensor, "4 4"],
    ) -> None:
        """One picture of a look of the camera; None where it was lost."""
        stamp = self._now + round(1e9 * index / self._rate)
        if index > 0:
            self._put("tf/world/tool", stamp, pose=world_T_tool)
        if depth is not None:
            self._put("camera/depth", stamp, depth=depth)
            self._put("camera/color", stamp, color=color)

    def looked(self, world_T_tool: Float[Tensor, "4 4"], frames: int) -> None:
        """The camera has looked, for so many frames; the first time perhaps for longer than later."""
        steps = self._steps_of(frames)
        if self._now == _START_NS:
            self._first_steps = steps
        self._now += steps * self._mini_ns
        self._put("tf/world/tool", self._now, pose=world_T_tool)

    def moved(self, world_T_tool: Float[Tensor, "K 4 4"]) -> None:
        """Where the tool was at the end of each mini step of an action; its pictures come before."""
        for index, pose in enumerate(world_T_tool):
            self._put("tf/world/tool", self._now + (index + 1) * self._mini_ns, pose=pose)
        self._now += len(world_T_tool) * self._mini_ns

    def bubble(self, which: int, index: int, depth: Float[Tensor, "H W"]) -> None:
        """A bubble's picture as it arrives at the end of a mini step."""
        self._put(f"{_BUBBLES[which]}/depth", self._now + (index + 1) * self._mini_ns, depth=depth)

    def about(self, region: Float[Tensor, "2 3"]) -> None:
        """Where the first view saw the object, grown."""
        self._region = region.clone()

    def mapping(self, thing: ObjectSettings | None = None) -> str:
        """The mapping file (TOML) by which `rumi replay --map` reads the streams.

        Args:
            thing: what the run was to find, where that was not the task's own object.
        """
        thing = ObjectSettings() if thing is None else thing
        sensors, shape = self._settings.sensors, self._shape
        topics = {}
        for _, _, about in self.kinds().values():
            if "role" in about:
                camera = f', camera = "/{about["camera"]}"' if "camera" in about else ""
                topics[about["topic"]] = f'{{ role = "{about["role"]}"{camera} }}'
        grown = torch.tensor([-_GROWN_M, -_GROWN_M, 0.0])
        low, high = self._region[0] + grown, self._region[1] - grown
        low[2] = low[2].clamp_min(0.0)
        kind = "" if thing.mesh is not None else self._spec.name.partition("-")[0]
        every = (self._settings.mini_steps + (self._look_steps if sensors.looks else 0)) * self._mini_ns
        lines = [
            "schema = 1",
            "[topics]",
            *(f'"{topic}" = {value}' for topic, value in topics.items()),
            '[frames]\nworld = "world"\ntool = "tool"',
            "[scene]",
            *([f'builtin = "{kind}"'] if kind in OBJECTS else []),
            f"within = [{_list(low)}, {_list(high)}]",
            f'search = "{self._spec.search}"',
            f"looks_again = {str(sensors.looks).lower()}\ntool_seen = true",
            *_object(thing),
            "[tool]",
            f"palm_m = {list(shape.palm_m)}\npalm_front_m = {shape.palm_front_m}",
            f"pad_m = {list(shape.pad_m)}\npad_offset_m = {shape.pad_offset_m}",
            '[view]\nsegmentation = "color"\nhue_deg = [200.0, 260.0]\npersist_s = 0.4\npersist_gap_s = 0.15',
            "[actions]",
            f"view_s = {self._first_steps * self._mini_ns / 1e9:.9f}\nevery_s = {every / 1e9:.9f}",
            f"instants = {every // self._mini_ns}",
        ]
        return "\n".join(lines) + "\n"

    def _steps_of(self, frames: int) -> int:
        """Mini steps that a look lasts: a whole number, so that an action and a look are as many instants."""
        return math.ceil(1e9 * frames / self._rate / self._mini_ns)

    def _lens(self, name: str, intrinsics: Float[Tensor, "3 3"], size: Sequence[int]) -> None:
        self._put(name, self._now, intrinsics=intrinsics, distortion=np.zeros(0), size=np.array(size, np.int32))

    def _put(self, name: str, stamp_ns: int, **values: Tensor | np.ndarray) -> None:
        if self.sink is not None:
            plain = {key: value.numpy() if isinstance(value, Tensor) else value for key, value in values.items()}
            self.sink(name, stamp_ns, plain)


def _object(thing: ObjectSettings) -> list[str]:
    """The table [object] of what is not as it is by default."""
    told = []
    for part in fields(thing):
        value = getattr(thing, part.name)
        if value != part.default:
            value = str(Path(value).resolve()) if part.name == "mesh" else value
            text = json.dumps(list(value) if isinstance(value, tuple) else value, ensure_ascii=False)
            told.append(f"{part.name} = {text}")
    return ["[object]", *told] if told else []


def _frames(parent: str, child: str, *, static: bool) -> dict[str, Any]:
    topic = "/tf_static" if static else "/tf"
    return {"topic": topic, "parent": parent, "child": child, "static": static}


def _list(numbers: Tensor) -> str:
    return "[" + ", ".join(f"{x:.4f}" for x in numbers.tolist()) + "]"
