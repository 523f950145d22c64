"""Messages of the bridge: one JSON object a line, UTF-8; metres, seconds, poses x y z and quaternion x y z w.

A message has a `type`, its class's name in small letters. What a client sends is checked by these classes; a field that
there is not, a value of another kind and a number that is none are refused by name.
"""

from typing import TYPE_CHECKING, Annotated, Any

from sdf.extras import optional

if TYPE_CHECKING:
    import msgspec
else:
    msgspec = optional("msgspec", "The bridge")

SCHEMA = 1
"""Of the messages."""

LINE = 1 << 23
"""Bytes of a line, at most."""

Number = Annotated[float, msgspec.Meta(ge=-1000.0, le=1000.0)]
Point = tuple[Number, Number, Number]
Pose = tuple[Number, Number, Number, Number, Number, Number, Number]


class Start(msgspec.Struct, tag="start", forbid_unknown_fields=True):
    """A run begins: the first view.

    Attributes:
        tool: pose of the tool, world_T_tool.
        surface: points seen on the object, world frame.
        free: points that are known to be free.
        seed: of all randomness.
        schema: of the client.
    """

    tool: Pose
    surface: tuple[Point, ...] = ()
    free: tuple[Point, ...] = ()
    seed: Annotated[int, msgspec.Meta(ge=0)] = 0
    schema: int = SCHEMA


class Sample(msgspec.Struct, tag="sample", forbid_unknown_fields=True):
    """A reading of one instant while an action is carried out, a thousand a second if you like.

    Attributes:
        tool: pose of the tool, by the measured joints.
        touched: points where it felt the object; true where it touched and nothing tells where; false for no touch.
        motion: how far the object has moved since the action began, world frame; none where nothing measures it.
    """

    tool: Pose
    touched: bool | tuple[Point, ...] = False
    motion: Pose | None = None


class Done(msgspec.Struct, tag="done", forbid_unknown_fields=True):
    """The action is over, at the last sample's pose.

    Attributes:
        stamp: seconds since the start of the run.
        clipped: metres of the commanded translation that the arm refused.
    """

    stamp: Number = 0.0
    clipped: Annotated[float, msgspec.Meta(ge=0.0, le=1000.0)] = 0.0


class Stop(msgspec.Struct, tag="stop", forbid_unknown_fields=True):
    """The run is to end with what it has."""


class Hello(msgspec.Struct, tag="hello"):
    """The server's first message.

    Attributes:
        schema: of the server.
        rumi: its version.
        control: what a control's numbers move.
        scale: metres and radians that a control of 1 asks for.
        measured: whether every sample needs `motion`.
        relies_on: what a run takes for granted.
        warnings: what is not measured, and may make a belief sure and wrong.
    """

    schema: int
    rumi: str
    control: tuple[str, ...]
    scale: list[float]
    measured: bool
    relies_on: str
    warnings: tuple[str, ...]


class Belief(msgspec.Struct, tag="belief"):
    """What is believed after an action.

    Attributes:
        step: actions so far.
        sure: whether the stopping rule holds.
        pose: as in result.json: best pose, covariance, probability, modes.
        remarks: what is odd.
    """

    step: int
    sure: bool
    pose: dict[str, Any]
    remarks: tuple[str, ...] = ()


class Action(msgspec.Struct, tag="action"):
    """What to do next.

    Attributes:
        control: in [-1, 1].
        path: poses of the tool to go through, evenly spread in time, if nothing is in the way.
    """

    control: list[float]
    path: list[list[float]]


class End(msgspec.Struct, tag="end"):
    """The run is over; another `start` begins the next one.

    Attributes:
        stopped_by: why.
        why_not: why the belief is not sure; none where it is.
        folder: of the run, on the server's machine.
    """

    stopped_by: str
    why_not: str | None
    folder: str | None


class Error(msgspec.Struct, tag="error"):
    """A message was refused and changed nothing, or with `fatal` the run ended.

    Attributes:
        message: what was expected, and what came.
        fatal: whether the run ended.
    """

    message: str
    fatal: bool = False


Asked = Start | Sample | Done | Stop
"""What a client sends."""

Told = Hello | Belief | Action | End | Error
"""What the server sends."""

decoder: msgspec.json.Decoder[Asked] = msgspec.json.Decoder(Asked)
encoder = msgspec.json.Encoder()
