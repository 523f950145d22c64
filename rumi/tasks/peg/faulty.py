"""What goes wrong in the peg task: the block is moved, the ball is off or feels what is not there."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.information.contact_gain import ContactKind
from rumi.sim.fault import Fault
from rumi.sim.object_faults import Knock
from rumi.sim.sensor_faults import FalseContact, HandOff
from rumi.tasks.peg.cell import Felt, TouchCell

KINDS = ("knock", "hand", "false-contact")
"""The faults of this task."""


def strike(cell: TouchCell, faults: Sequence[Fault], step: int) -> None:
    """Move the block before the motion at which a knock is due."""
    for fault in faults:
        if isinstance(fault, Knock) and fault.step == step:
            cell.truth = fault.struck(cell.truth)


def follow(cell: TouchCell, points: Float[Tensor, "K 3"], faults: Sequence[Fault], step: int) -> Felt:
    """Carry out a motion as the robot takes it to be; what it reports of it.

    Args:
        cell: table, block and ball.
        points: of the ball's centre, as the robot takes it to be.
        faults: of `KINDS`.
        step: number of the motion, from 1 on.
    """
    off, cut = torch.zeros(3, dtype=torch.float64), None
    for fault in faults:
        if fault.step <= step and isinstance(fault, HandOff):
            off += fault.aside().double()
        if fault.step <= step and isinstance(fault, FalseContact):
            chance, share, angle = torch.rand(3, generator=fault.drawn(step)).tolist()
            cut = (share, 2.0 * torch.pi * angle) if chance < fault.size else cut
    if off.any():
        points = _path_from(cell.tip, points[1:] - off)
    low = cell.block.height_m + cell.radius
    if cut is None or not bool((points[:, 2] < low).any()):
        felt = cell.follow(points)
    else:
        felt = cell.follow(_shortened(points, cut[0], low))
        if felt.kind == ContactKind.NOTHING:
            away = torch.tensor([cut[1]], dtype=torch.float64)
            normal = torch.cat((away.cos(), away.sin()))
            felt = replace(felt, kind=ContactKind.TOUCH, point=felt.tip[:2] - cell.radius * normal, normal=normal)
    return _reported(felt, off)


def _path_from(tip: Float[Tensor, "3"], points: Float[Tensor, "K 3"]) -> Float[Tensor, "K1 3"]:
    """A way from where the ball is, level or straight up and down throughout."""
    ways = [tip]
    for point in points:
        if float((point - ways[-1])[:2].norm()) > 0 and float((point - ways[-1])[2].abs()) > 0:
            ways.append(torch.cat((ways[-1][:2], point[2:])))
        ways.append(point)
    return torch.stack(ways)


def _shortened(points: Float[Tensor, "K 3"], share: float, low: float) -> Float[Tensor, "k 3"]:
    """A way up to a share of its first level part near the table."""
    kept = [points[0]]
    for start, end in pairwise(points):
        if float(start[2]) < low and float((end - start)[:2].norm()) > 0:
            return torch.stack([*kept, start + share * (end - start)])
        kept.append(end)
    return torch.stack(kept)


def _reported(felt: Felt, off: Float[Tensor, "3"]) -> Felt:
    """What a ball that takes itself to be off reports."""
    if not off.any():
        return felt
    return replace(felt, tip=felt.tip + off, point=felt.point + off[:2], free=felt.free + off[:2], path=felt.path + off)
