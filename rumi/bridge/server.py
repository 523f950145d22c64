"""The bridge's server: a run for each `start` of a client, one client at a time, on and on."""

import contextlib
import socket
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from rumi import __version__, api
from rumi.bridge.messages import SCHEMA, Belief, End, Error, Hello, Start
from rumi.bridge.served import ClientGoneError, ServedRobot, Wire
from rumi.errors import DegenerateBeliefError, UsageError
from rumi.runs.folder import free_folder
from rumi.runs.progress import say


@dataclass(frozen=True)
class Served:
    """What is served.

    Attributes:
        agent: that finds the object: a `Rummager`.
        within: (2, 3), box that holds it.
        out: folder of the runs' folders; None keeps none.
        patience_s: seconds without a message after which a client counts as gone; None waits for ever.
    """

    agent: Any  # or one with its tool, filter and model
    within: Float[Tensor, "2 3"]
    out: Path | None = None
    patience_s: float | None = None


def listen(host: str, port: int) -> socket.socket:
    """A socket that clients connect to.

    Raises:
        UsageError: the address cannot be had.
    """
    try:
        return socket.create_server((host, port))
    except (OSError, OverflowError) as error:
        raise UsageError(f"Cannot listen on {host}, port {port}: {error}; give another --port or --host") from error


def serve(served: Served, listener: socket.socket, clients: int | None = None) -> None:
    """Serve clients one after the other; nothing that one does ends it.

    Args:
        served: what is served.
        listener: of `listen`.
        clients: that are served at most; None for no end, until Ctrl-C.
    """
    count = 0
    while clients is None or count < clients:
        connection, address = listener.accept()
        count += 1
        with connection, contextlib.suppress(OSError):  # a client that has gone meanwhile
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            say(f"client {address[0]} port {address[1]}")
            try:
                _talk(served, Wire(connection, served.patience_s))
            except ClientGoneError as error:
                say(str(error))


def _talk(served: Served, wire: Wire) -> None:
    """All runs of one client."""
    agent = served.agent
    axes = ("x", "y", "z", "yaw") if agent.tool.spatial else ("x", "y", "yaw")
    measured = agent.filter.settings.motion == "measured"
    scale = [float(value) for value in agent.tool.scale]
    wire.tell(Hello(SCHEMA, __version__, axes, scale, measured, agent.relies_on, tuple(agent.warnings)))
    while True:
        start = wire.expect(Start)
        if start.schema != SCHEMA:
            wire.tell(Error(f"Expected schema {SCHEMA}, got {start.schema}: update the older of the two"))
            continue
        try:
            _run(served, wire, start)
        except ClientGoneError:
            raise
        except (ValueError, DegenerateBeliefError) as error:  # of readings that make no sense
            wire.tell(Error(str(error), fatal=True))
        except Exception as error:  # a bug of ours is no reason to leave the others alone
            traceback.print_exc()
            wire.tell(Error(f"the run broke off: {type(error).__name__}: {error}", fatal=True))


def _run(served: Served, wire: Wire, start: Start) -> None:
    agent = served.agent
    robot = ServedRobot(wire, start, agent.tool, agent.filter.settings.motion == "measured", served.within)
    folder = None if served.out is None else free_folder(served.out / "run")

    def tell(step: Any) -> None:  # noqa: ANN401  (a `StepRecord`)
        tolerance = {"within_m": agent.position_tolerance_m, "within_rad": agent.rotation_tolerance_rad}
        pose = step.belief.summary(agent.model.symmetries, **tolerance)
        wire.tell(Belief(step.step, step.converged, pose.as_dict(), tuple(remark.name for remark in step.remarks)))

    try:
        result = api.run(robot, agent, seed=start.seed, folder=folder, on_step=tell)
    except BaseException:
        if folder is not None:
            with contextlib.suppress(OSError):  # it holds the steps that there were
                folder.rmdir()
        raise
    wire.tell(End(result.stopped_by, result.why_not, None if folder is None else str(folder)))
    if result.stopped_by == "interrupted" and not robot.stopped:
        raise KeyboardInterrupt
