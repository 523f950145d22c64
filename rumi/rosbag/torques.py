"""Contact samples by joint torques in a recording, and the pose of the robot's body over time."""

import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.errors import UsageError
from rumi.rosbag.contact_sample import ContactSample, ContactSamples
from rumi.rosbag.frames import FrameTree
from rumi.rosbag.mapping import BagMap
from rumi.rosbag.sensor_maps import RobotMap
from rumi.rosbag.span import Span
from rumi.rosbag.streams import role_of
from sensors.force.momentum_observer import MomentumObserver, TorqueThreshold, residuals
from sensors.log.reader import Log, Stream
from sensors.vision.robot_body import RobotBody


def torque_contacts(stream: Stream, mapping: BagMap, span: Span, found: ContactSamples) -> list[ContactSample]:
    """Contacts of unknown place: when the momentum observer's residual of a stream of joints exceeds its threshold.

    Raises:
        UsageError: a table of the mapping, a joint, or what was measured of it is missing.
    """
    config, robot = mapping.torques, mapping.robot
    if config is None or robot is None:
        raise UsageError(f"Expected tables [torques] and [robot] in the mapping for {stream.name}, found no such")
    if stream.kind != "joints":
        raise UsageError(f"Expected {stream.name} to be of joints (JointState) for the role torques, got {stream.kind}")
    if len(stream) == 0:
        return []
    from rumi.sim.robot_dynamics import MujocoDynamics

    names = [str(name) for name in stream.about.get("names", ())]
    asked = list(config.joints) or names
    if lacking := [name for name in asked if name not in names]:
        raise UsageError(f"Expected the joint {lacking[0]!r} in {stream.name}, which has {', '.join(names)}")
    _text(robot)  # says which file cannot be read
    # by its path: an MJCF's meshes lie beside it
    dynamics = MujocoDynamics.load(Path(robot.file), asked)
    track = JointTrack(stream, span)
    found.problems += track.problems
    column = [names.index(name) for name in asked]
    values = {key: table[:, column] for key, table in track.tables.items()}
    for key, what in (("velocity", "velocities"), ("effort", "efforts: torques, N m")):
        if not bool(torch.isfinite(values[key]).any()):
            raise UsageError(f"Expected {stream.name} to hold {what}, found none")
    whole = torch.stack([torch.isfinite(table).all(-1) for table in values.values()]).all(0)
    if lost := int((~whole).sum()):
        found.problems.append(f"stream {stream.name}: {lost} of {len(whole)} rows lack some of {', '.join(asked)}")
    stamps = track.stamps_ns[whole]
    if len(stamps) == 0:
        return []
    seconds = (stamps - span.start_ns).double() / 1e9
    residual = residuals(
        dynamics,
        seconds,
        values["position"][whole],
        values["velocity"][whole],
        values["effort"][whole],
        MomentumObserver(config.gain),
    )
    threshold = TorqueThreshold(config.threshold_nm, config.counted)
    early = seconds <= config.rest_s
    if config.rest_s > 0:
        # by then the filter has forgotten that it began at 0
        late = early & (seconds >= min(0.5 * config.rest_s, float(seconds[0]) + 5.0 / config.gain))
        if bool(late.any()):
            threshold = threshold.at_rest(residual[late])
        else:
            found.problems.append(
                f"stream {stream.name}: nothing in the first {config.rest_s:g} s; a rest of 0 is taken"
            )
    norm = threshold.norm(residual)
    touched = norm > config.threshold_nm
    touched &= ~early
    found.notes.append(
        f"torques {stream.name}: {int(touched.sum())} of {len(touched)} samples beyond {config.threshold_nm:g} N m; "
        f"the most was {float(norm.amax()):.2f} N m"
    )
    return [ContactSample(at, torch.zeros(0, 3), True, signal=config.likelihood) for at in stamps[touched].tolist()]


class JointTrack:
    """A stream of joints, by time.

    Args:
        stream: of joints.
        span: what is used of the recording; all by default.

    Attributes:
        names: of the joints.
        stamps_ns: (n), rising.
        tables: position, velocity and effort, each (n, J), NaN where it was not given.
        problems: what could not be used.

    Raises:
        UsageError: the stream does not say which joints it is of.
    """

    def __init__(self, stream: Stream, span: Span | None = None) -> None:
        if "names" not in stream.about:
            raise UsageError(f"Expected stream {stream.name} to name its joints, found no names")
        self.names = tuple(str(name) for name in stream.about["names"])
        every = stream.samples() if span is None else stream.samples(span.start_ns, span.read_ns)
        tables = ("position", "velocity", "effort")
        samples = [
            one for one in every if all(np.asarray(one.values[key]).shape == (len(self.names),) for key in tables)
        ]
        self.problems: list[str] = []
        if lost := len(every) - len(samples):
            self.problems.append(
                f"stream {stream.name}: {lost} of {len(every)} rows are not of its {len(self.names)} joints, left out"
            )
        self.stamps_ns: Int[Tensor, "n"] = torch.tensor([one.stamp_ns for one in samples], dtype=torch.long)
        self.tables: dict[str, Float[Tensor, "n J"]] = {
            key: torch.tensor([one.values[key].tolist() for one in samples], dtype=torch.float64).reshape(  # type: ignore[union-attr]
                len(samples), len(self.names)
            )
            for key in tables
        }

    def position(self, stamp_ns: int, gap_ns: int) -> tuple[dict[str, float], Bool[Tensor, ""]]:
        """Positions by name at a time, between the rows about it, and whether these are near enough."""
        if len(self.stamps_ns) == 0:
            return {}, torch.tensor(False)
        after = int(torch.searchsorted(self.stamps_ns, stamp_ns).clamp_max(len(self.stamps_ns) - 1))
        before = max(0, after - 1) if int(self.stamps_ns[after]) > stamp_ns else after
        low, high = int(self.stamps_ns[before]), int(self.stamps_ns[after])
        part = min(1.0, max(0.0, (stamp_ns - low) / max(1, high - low)))
        near = torch.tensor(max(stamp_ns - low, high - stamp_ns) <= gap_ns)
        value = torch.lerp(self.tables["position"][before], self.tables["position"][after], part)
        return {name: x for name, x in zip(self.names, value.tolist(), strict=True) if math.isfinite(x)}, near


class BodyTrack:
    """Poses of the links of a recording's robot over time.

    Args:
        robot: its model.
        log: with streams of joints.
        mapping: what they mean.
        frames: where its base was.

    Raises:
        UsageError: no URDF, or no joints in the recording.

    Attributes:
        body: the links' shapes.
    """

    def __init__(self, robot: RobotMap, log: Log, mapping: BagMap, frames: FrameTree) -> None:
        from rumi.robot.urdf import UrdfBody

        text = _text(robot)
        if not (text.lstrip().startswith("<") and "<robot" in text):
            raise UsageError(f"Expected robot.file to be a URDF for robot.remove, got {robot.file}")
        folders = {Path(folder).resolve().name: Path(folder) for folder in robot.packages}
        self._urdf = UrdfBody.load(robot.file, packages=folders)
        self.body: RobotBody = self._urdf.body
        self._tracks = [
            JointTrack(stream)
            for stream in log.streams.values()
            if stream.kind == "joints" and len(stream) and role_of(stream, mapping) in ("joints", "torques")
        ]
        if not self._tracks:
            raise UsageError("Expected a topic with the role joints or torques for robot.remove, found none")
        self._frames, self._base = frames, robot.base or mapping.frames.world
        self._gap_ns = int(mapping.frames.longest_gap_s * 1e9)

    def at(self, stamp_ns: int) -> Float[Tensor, "L 4 4"]:
        """world_T_links at a time.

        Raises:
            ValueError: it is not known then.
        """
        base, known = self._frames.at(self._base, [stamp_ns])
        joints: dict[str, float] = {}
        for track in self._tracks:
            found, near = track.position(stamp_ns, self._gap_ns)
            if bool(near):
                joints |= found
        if not bool(known.all()) or any(name not in joints for name in self._urdf.joints):
            raise ValueError(f"where the robot was at {stamp_ns} is not known")
        return self._urdf.poses(joints, base[0].float())


def _text(robot: RobotMap) -> str:
    path = Path(robot.file)
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"Cannot read robot.file {path}: {error}") from error
