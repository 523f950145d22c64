"""The command `rumi serve`: finds an object for a robot in another process, which talks by messages over a socket."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from rumi.belief.motion import Motion
from rumi.cache import cache_folder
from rumi.commands.flags import FLAGS
from rumi.errors import UsageError
from rumi.exit_codes import DONE, INTERRUPTED
from rumi.rosbag.mapping import ToolMap
from rumi.rosbag.sensor_maps import Vector
from rumi.tasks.rummage.objects import ObjectSettings

if TYPE_CHECKING:
    from rumi.bridge.server import Served


@dataclass(frozen=True)
class ServeOptions:
    """Find an object for a robot in another process, which sends readings and gets beliefs and actions.

    One JSON message a line (scripts/docs/reference/bridge.md); scripts/bridge_client.py is a client. Only this
    machine can connect unless --host says otherwise; there is no password.

    Attributes:
        object: the object; or --builtin.
        builtin: one of rumi's objects in its place: mug, box or drill.
        tool: its shape.
        workspace: lower and upper corner of where the tool may be, metres; of the same height for a tool in the plane.
        within: lower and upper corner of a box that holds the object; by default the workspace, 0.3 m high.
        motion: how the object's motion is known; by default no sample tells it.
        prior_mean: x and y that the object is known to be about, where the robot does not look at it first.
        prior_spread: standard deviation of that, metres.
        prior_up: axes of the object one of which points up, such as xyz where it may lie on any of its sides.
        action_m: metres that a control of 1 asks for.
        action_rad: radians that it asks for.
        preset: settings to start from: default, fast or paper.
        steps: actions at most.
        host: address to listen on.
        port: to listen on; 0 for any that is free.
        out: folder in which each run gets a folder.
        patience: seconds without a message after which a client counts as gone.
    """

    workspace: tuple[Vector, Vector]
    object: Annotated[ObjectSettings, tyro.conf.arg(name="")] = field(default_factory=ObjectSettings)
    builtin: str | None = None
    tool: ToolMap = field(default_factory=ToolMap)
    within: tuple[Vector, Vector] | None = None
    motion: Motion | None = None
    prior_mean: tuple[float, float] | None = None
    prior_spread: float = 0.05
    prior_up: str = "z"
    action_m: float = 0.08
    action_rad: float = 0.5
    preset: str = "default"
    steps: int = 40
    host: str = "127.0.0.1"
    port: int = 7711
    out: Path = Path("runs/served")
    patience: float = 600.0


def serve(arguments: Sequence[str]) -> int:
    """`rumi serve`: goes on until Ctrl-C; 2 for bad input."""
    options = tyro.cli(ServeOptions, prog="rumi serve", args=arguments, registry=FLAGS)
    from sdf.extras import optional

    optional("msgspec", "rumi serve")
    from rumi.bridge.server import listen
    from rumi.bridge.server import serve as serve_clients
    from rumi.runs.progress import say

    served = made(options)
    with listen(options.host, options.port) as listener:
        host, port = listener.getsockname()[:2]
        say(f"serving on {host}, port {port}; runs go to {options.out}; Ctrl-C ends it")
        try:
            serve_clients(served, listener)
        except KeyboardInterrupt:
            return INTERRUPTED
    return DONE


def made(options: ServeOptions) -> "Served":
    """The agent that is served.

    Raises:
        UsageError: an option that cannot be.
    """
    import torch

    from rumi.bridge.server import Served
    from rumi.fields.workspace import Workspace
    from rumi.runs.folder import make_folder
    from rumi.tasks.rummage.objects import OBJECTS, own_model
    from rumi.tasks.rummage.own import rummager, unmeasured
    from rumi.tasks.rummage.scene_spec import PriorSpec
    from rumi.tasks.rummage.settings import preset

    if (options.builtin is None) == (options.object.mesh is None):
        raise UsageError("Expected the object, by --mesh FILE or by --builtin NAME, one of the two")
    if options.motion == "auto":
        raise UsageError("Expected another --motion, got auto: leave it out where nothing measures the motion")
    if not options.patience > 0:
        raise UsageError(f"Expected --patience above 0, got {options.patience}")
    low, high = torch.tensor(options.workspace)
    spatial = bool(low[2] < high[2])
    if not bool((low[:2] < high[:2]).all()) or bool(low[2] > high[2]):
        raise UsageError(f"Expected --workspace to be a lower and an upper corner, got {options.workspace}")
    if options.within is not None:
        within = torch.tensor(options.within)
    else:
        within = torch.tensor([[*low[:2].tolist(), 0.0], [*high[:2].tolist(), 0.3]])
    make_folder(options.out)
    if options.builtin is not None:
        model = OBJECTS[options.builtin]()
    else:
        model = own_model(options.object, cache_dir=cache_folder())
    planar = None if spatial else float(low[2])
    workspace = Workspace.from_bounds(torch.stack((low, high)), 0.02 if spatial else 0.01, planar_height=planar)
    settings, tool = preset(options.preset, steps=options.steps), options.tool.shape()
    prior = None if options.prior_mean is None else PriorSpec(options.prior_mean, options.prior_spread)
    agent = rummager(
        model,
        workspace,
        tool=tool,
        motion=options.motion or unmeasured(settings, workspace, tool=tool, prior=prior),
        prior=prior,
        up=tuple(options.prior_up),
        action_m=options.action_m,
        action_rad=options.action_rad,
        settings=settings,
    )
    return Served(agent, within, options.out, options.patience)
