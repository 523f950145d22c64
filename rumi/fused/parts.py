"""What a fused run is made of."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.assemble import build_rummager
from rumi.config import preset
from rumi.fused.filter import FusedFilter
from rumi.fused.grasp import HandleTable, handle_table
from rumi.fused.settings import FusedSettings, task_of
from rumi.planning.gripper import GripperShape
from rumi.planning.tool import Tool
from rumi.rummager import Rummager
from rumi.sim.fused_task import FusedTask
from rumi.sim.handle_grasp import HandleGripper
from rumi.sim.tasks import make_tool


@dataclass(frozen=True)
class FusedParts:
    """Everything that a run needs beside its seed; may be used for many.

    Attributes:
        settings: of the run.
        task: the scene with its sensors.
        rummager: how the mug is found; the same for all sensors.
        gripper: grasps it.
        table: chance that it does, by how far off the mug is.
        surface: (n, 3), points on the gripper's surface, tool frame: where a contact signal may come from.
    """

    settings: FusedSettings
    task: FusedTask
    rummager: Rummager
    gripper: HandleGripper
    table: HandleTable
    surface: Float[Tensor, "n 3"]


def build_fused(
    settings: FusedSettings,
    *,
    cache_dir: Path | None = None,
    tool: Tool | None = None,
    table: HandleTable | None = None,
) -> FusedParts:
    """Make the parts of a run.

    Args:
        settings: of the run.
        cache_dir: folder that keeps the arm's reach and the table of grasps; None works them out each time (a minute).
        tool: made before by `make_tool`; None makes one.
        table: made before by `handle_table`; None makes one.
    """
    spec, plain = task_of(settings), preset(settings.preset, task="mug-0")
    tool, model = tool or make_tool(spec, cache_dir=cache_dir), spec.object_factory()
    task = FusedTask(settings, tool, model, cache_dir=cache_dir)
    rummager = build_rummager(spec, plain, model, tool)
    # a camera feels nothing that a belief could wait for; touches that are none cost what no pose explains
    contacts = 0 if settings.sensors == ("camera",) else settings.contacts
    stop = replace(plain.stop, fit_a_contact=settings.fit_a_contact, contacts=contacts)
    gripper = HandleGripper(model.exact, task.world.body, spec.physics)
    return FusedParts(
        settings,
        task,
        replace(rummager, filter=FusedFilter.of(rummager.filter), stop=stop),
        gripper,
        table or handle_table(gripper, cache_dir=cache_dir),
        gripper_surface(tool.shape, settings.signals.spacing_m).float(),
    )


def gripper_surface(shape: GripperShape, spacing_m: float) -> Float[Tensor, "n 3"]:
    """Points on pads and palm, about `spacing_m` apart; those of the palm that the pads cover are left in."""
    sides = torch.tensor(shape.palm_m, dtype=torch.float64)
    axes = [torch.linspace(-0.5, 0.5, max(2, math.ceil(side / spacing_m) + 1), dtype=torch.float64) for side in sides]
    lattice = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    palm = lattice[(lattice.abs() == 0.5).any(-1)] * sides
    palm[:, 0] += shape.palm_center_m
    return torch.cat((shape.pad_shell(spacing_m), palm))
