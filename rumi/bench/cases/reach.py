"""What moving the object out of reach costs."""

import torch
from torch import Tensor

from rumi.bench.case import Case, Setup, Variant, cases, largest_difference
from rumi.bench.scenes import SCENES, FieldScene
from rumi.fields.information import information_field
from rumi.planning.reach_cost import ReachabilityCost
from rumi.seeding import split
from sdf.voxel_grid import VoxelGrid


def reach_inputs(setup: Setup, scene: FieldScene) -> tuple[VoxelGrid, VoxelGrid, Tensor]:
    """Information, reachability and displacements (R, H, 3)."""
    fields = information_field(scene.model.sdf, scene.world_T_object, scene.log_weights, scene.points)
    information = scene.workspace.grid(fields.information)
    # falls with the distance from a base, as an arm's does
    away = (scene.points[:, :2] + torch.tensor([0.45, 0.0], device=setup.device)).norm(dim=-1)
    reachability = scene.workspace.grid((1.0 - (away - 0.6).clamp_min(0.0) / 0.6).clamp(0.0, 1.0))
    random = split(0, "bench/reach")
    count, horizon = setup.size(2500, 20), setup.size(15, 4)
    flat = torch.tensor([1.0, 1.0, 0.0 if scene.workspace.planar else 0.3])
    steps = 0.03 * torch.randn(count, horizon, 3, generator=random) * flat
    return information, reachability, steps.cumsum(1).to(setup.device)


@cases({"reach-mug": ("mug",), "reach-box": ("box",)})
def reach(setup: Setup, name: str) -> Case:
    """Reachability cost, of the mug on a planar lattice, of the box on a 3-D one."""
    scene = SCENES[name](setup)
    information, reachability, moved = reach_inputs(setup, scene)

    def wide(grid: VoxelGrid) -> VoxelGrid:
        return VoxelGrid(grid.values.double(), grid.origin.double(), grid.spacing)

    few = moved[: setup.size(50, 5)]
    reference = ReachabilityCost(wide(information), wide(reachability))(few.double())
    run = Variant("torch, one correlation", lambda: ReachabilityCost(information, reachability)(moved), version="torch")
    return Case(
        f"reachability cost (Alg 8): {moved[..., 0].numel()} displacements, table included: {scene.what}",
        (run,),
        otherwise="torch, one correlation",
        items=moved[..., 0].numel(),
        item="displacement",
        error=lambda found, truth: largest_difference(found[: len(truth)], truth),
        tolerance=1e-5,
        reference=reference,
        facts={
            "error": "of the cost, in [-1, 0], against float64",
            "costs": [round(float(reference.min()), 3), round(float(reference.max()), 3)],
        },
    )
