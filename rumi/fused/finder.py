"""How the mug of a fused run is found: all that a belief needs beside its readings; nothing here simulates."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.assemble import build_rummager
from rumi.config import preset
from rumi.fused.filter import FusedFilter
from rumi.fused.settings import FusedSettings, task_of
from rumi.planning.gripper import GripperShape
from rumi.planning.tool import Tool
from rumi.rummager import Rummager
from rumi.sim.tasks import make_tool
from sdf.object_model import ObjectModel


@dataclass(frozen=True)
class Finder:
    """The same for a live run and for one from a log, and for all sensors.

    Attributes:
        settings: of the run.
        rummager: whose filter is a `FusedFilter`.
        surface: (n, 3), points on the gripper's surface, tool frame: where a contact signal may come from.
    """

    settings: FusedSettings
    rummager: Rummager
    surface: Float[Tensor, "n 3"]

    @property
    def filter(self) -> FusedFilter:
        """The rummager's."""
        assert isinstance(self.rummager.filter, FusedFilter)
        return self.rummager.filter


def build_finder(
    settings: FusedSettings,
    *,
    cache_dir: Path | None = None,
    tool: Tool | None = None,
    model: ObjectModel | None = None,
) -> Finder:
    """Make it of settings.

    Args:
        settings: of the run.
        cache_dir: folder that keeps the arm's reach; None works it out each time (half a minute).
        tool: made before by `make_tool`; None makes one.
        model: of the mug; None makes it.
    """
    spec, plain = task_of(settings), preset(settings.preset, task="mug-0")
    tool, model = tool or make_tool(spec, cache_dir=cache_dir), model or spec.object_factory()
    rummager = build_rummager(spec, plain, model, tool)
    # a camera feels nothing that a belief could wait for; touches that are none cost what no pose explains
    contacts = 0 if settings.sensors == ("camera",) else settings.contacts
    stop = replace(plain.stop, fit_a_contact=settings.fit_a_contact, contacts=contacts)
    return Finder(
        settings,
        replace(rummager, filter=FusedFilter.of(rummager.filter), stop=stop),
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
