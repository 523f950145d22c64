"""A robot in another process as a `rumi.Task`: its readings come over a socket, and actions go back."""

import socket
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.bridge.messages import LINE, Action, Asked, Done, Error, Pose, Sample, Start, Stop, Told, decoder, encoder
from rumi.robot.tool import Tool
from rumi.rosbag.mapping import pose_of
from sdf import se3, so3
from sensors.observation import Observation, concatenate
from sensors.reading import Reading
from sensors.semantics import Semantics
from sensors.touch.touch_readings import TouchReadings

INSTANTS = 20
"""Of a reading, at most: more samples of an action are thinned, and of each group one that touched is kept."""

_MOST = 200_000  # samples of one action
_PATH = 20
_UNIT = 0.05  # that a quaternion's length may differ from 1

M = TypeVar("M", bound=Asked)


class ClientGoneError(Exception):
    """The connection ended, or nothing came for too long."""


class Wire:
    """Messages over a socket; what is none is answered by an error and passed over.

    Args:
        connection: to the client.
        patience_s: seconds without a message after which the client counts as gone.
    """

    def __init__(self, connection: socket.socket, patience_s: float | None = None) -> None:
        connection.settimeout(patience_s)
        self._connection, self._lines = connection, connection.makefile("rb")

    def tell(self, message: Told) -> None:
        """Send a message.

        Raises:
            ClientGoneError: nobody takes it.
        """
        try:
            self._connection.sendall(encoder.encode(message) + b"\n")
        except OSError as error:
            raise ClientGoneError(f"the client is gone: {error}") from error

    def hear(self) -> Asked:
        """The next message that is one.

        Raises:
            ClientGoneError: there is none, or a line is too long to go on from.
        """
        while True:
            try:
                line = self._lines.readline(LINE)
            except OSError as error:
                raise ClientGoneError(f"the client is gone: {error}") from error
            if not line.endswith(b"\n"):
                if len(line) == LINE:
                    self.tell(Error(f"Expected lines of less than {LINE} bytes, got a longer one", fatal=True))
                raise ClientGoneError("the client is gone: it closed the connection, or sent no lines")
            try:
                return decoder.decode(line)
            except (ValueError, RecursionError) as error:
                self.tell(Error(str(error)))

    def expect(self, *kinds: type[M]) -> M:
        """The next message of some kinds; others are refused."""
        while True:
            message = self.hear()
            if isinstance(message, kinds):
                return message
            names = " or ".join(kind.__name__.lower() for kind in kinds)
            self.tell(Error(f"Expected {names} now, got {type(message).__name__.lower()}"))


class ServedRobot:
    """A `rumi.Task` whose robot is a client.

    Args:
        wire: to the client.
        start: of the run, as the client sent it.
        tool: of the agent.
        measured: whether every sample needs the object's motion.
        within: (2, 3), box that holds the object.
    """

    def __init__(self, wire: Wire, start: Start, tool: Tool, measured: bool, within: Float[Tensor, "2 3"]) -> None:
        self._wire, self._start, self._tool, self._measured = wire, start, tool, measured
        self._readings = TouchReadings(tool.shape.solid(0.004), within, spatial=tool.spatial)
        self._at: Tensor = torch.zeros(0)
        self.stopped = False

    def reset(self, seed: int) -> Reading:
        """The first view, which has come with the start."""
        start = self._start
        seen = [(start.surface, Semantics.SURFACE), (start.free, Semantics.FREE)]
        view = concatenate([Observation.of(torch.tensor(points).reshape(-1, 3), kind) for points, kind in seen])
        return self._kept(self._readings.first(view, matrix(start.tool)))

    def step(self, action: Float[Tensor, "A"]) -> Reading:
        """Tell the client what to do, and take its samples until it is done.

        Raises:
            KeyboardInterrupt: the client ended the run, as Ctrl-C does: it ends with what it has.
        """
        path = self._tool.free_path(self._at, action[None].clamp(-1.0, 1.0), _PATH)
        self._wire.tell(Action(action.tolist(), [numbers(pose) for pose in self._tool.pose(path)]))
        samples: list[Sample] = []
        while True:
            message = self._wire.expect(Sample, Done, Stop)
            if isinstance(message, Stop):
                self.stopped = True
                raise KeyboardInterrupt
            if isinstance(message, Sample):
                if refusal := self._refusal(message, len(samples)):
                    self._wire.tell(Error(refusal))
                else:
                    samples.append(message)
            elif not samples:
                self._wire.tell(Error("Expected a sample before done, got none: where is the tool?"))
            else:
                assert isinstance(message, Done)
                return self._kept(self._reading(thinned(samples), message))

    def finish(self, action: object) -> None:
        """Nothing is done at the end."""

    def close(self) -> None:
        """The connection is the server's."""

    def _refusal(self, sample: Sample, count: int) -> str | None:
        """Why a sample is not taken; None where it is."""
        if count >= _MOST:
            return f"Expected at most {_MOST} samples of an action, got more: send done"
        if self._measured and sample.motion is None:
            return "Expected motion in every sample, since the object's motion is said to be measured, got none"
        for name, pose in (("tool", sample.tool), ("motion", sample.motion)):
            if pose is not None and abs(sum(value * value for value in pose[3:]) ** 0.5 - 1.0) > _UNIT:
                return f"Expected {name} to end in a unit quaternion x y z w, got {list(pose[3:])}"
        return None

    def _reading(self, samples: list[Sample], done: Done) -> Reading:
        touched = [sample.touched for sample in samples]
        felt = [None if one is True else torch.tensor(one or []).reshape(-1, 3) for one in touched]
        poses, motion = torch.stack([matrix(sample.tool) for sample in samples]), None
        if self._measured:
            motion = torch.stack([matrix(sample.motion) for sample in samples if sample.motion is not None])
        return self._readings.reading(poses, felt, motion, clipped_m=done.clipped, stamp=done.stamp)

    def _kept(self, reading: Reading) -> Reading:
        self._at = reading.configuration
        return reading


def thinned(samples: list[Sample], most: int = INSTANTS) -> list[Sample]:
    """At most so many samples of an action, the last one among them: of each group the last that touched, or the last.

    Args:
        samples: in the order of time.
        most: groups, of the same size but for one.
    """
    *before, last = samples
    size = max(1, -(-len(before) // max(1, most - 1)))
    groups = [before[at : at + size] for at in range(0, len(before), size)]
    return [*(next((one for one in reversed(group) if one.touched), group[-1]) for group in groups), last]


def matrix(pose: Pose) -> Float[Tensor, "4 4"]:
    """(4, 4) of a position and a quaternion x y z w, which is normalised.

    Raises:
        ValueError: the quaternion is of no rotation.
    """
    x, y, z, w = pose[3:]
    return pose_of(pose[:3], (w, x, y, z)).float()


def numbers(pose: Float[Tensor, "4 4"]) -> list[float]:
    """Position and quaternion x y z w of a pose."""
    pose = se3.renormalised(pose.double())
    return [*pose[:3, 3].tolist(), *so3.quaternion(pose[:3, :3]).tolist()]
