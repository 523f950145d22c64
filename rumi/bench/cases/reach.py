"""What moving the object out of reach costs."""

import torch

from rumi.bench import naive
from rumi.bench.case import Case, Setup, Target, Variant, case, largest_difference
from rumi.bench.scenes import SCENES, FieldScene
from rumi.fields.information import information_field
from rumi.planning.reach_cost import ReachabilityCost
from rumi.seeding import split
from sdf.voxel_grid import VoxelGrid

_DIRECT = "sum for every displacement"


def _reach(setup: Setup, scene: FieldScene, limit_s: float) -> Case:
    fields = information_field(scene.model.sdf, scene.world_T_object, scene.log_weights, scene.points)
    information = scene.workspace.grid(fields.information)
    # falls with the distance from a base, as an arm's does
    away = (scene.points[:, :2] + torch.tensor([0.45, 0.0], device=setup.device)).norm(dim=-1)
    reachability = scene.workspace.grid((1.0 - (away - 0.6).clamp_min(0.0) / 0.6).clamp(0.0, 1.0))
    random = split(0, "bench/reach")
    count, horizon, some = setup.size(2500, 20), setup.size(15, 4), setup.size(50, 5)
    flat = torch.tensor([1.0, 1.0, 0.0 if scene.workspace.planar else 0.3])
    steps = 0.03 * torch.randn(count, horizon, 3, generator=random) * flat
    moved = steps.cumsum(1).to(setup.device)

    def wide(grid: VoxelGrid) -> VoxelGrid:
        return VoxelGrid(grid.values.double(), grid.origin.double(), grid.spacing)

    few = moved[:some]
    reference = naive.reach_cost(wide(information), wide(reachability), few.double())
    return Case(
        f"reachability cost (Alg 8): {count * horizon} displacements, table included: {scene.what}",
        (
            *(
                Variant(
                    f"{version}, one correlation",
                    lambda: ReachabilityCost(information, reachability)(moved),
                    version=version,
                )
                for version in setup.versions[:1]
            ),
            Variant(_DIRECT, lambda: naive.reach_cost(information, reachability, few), "naive", share=some / count),
        ),
        (_DIRECT,),
        count * horizon,
        "displacement",
        (Target("torch, one correlation", at_most_s=limit_s),),
        lambda found, truth: largest_difference(found[: len(truth)], truth),
        1e-5,
        reference=reference,
        facts={
            "error": "of the cost, in [-1, 0], against float64 sums",
            "costs": [round(float(reference.min()), 3), round(float(reference.max()), 3)],
        },
    )


@case("reach-mug")
def reach_mug(setup: Setup) -> Case:
    """Reachability cost on a planar lattice."""
    return _reach(setup, SCENES["mug"](setup), 1e-3)


@case("reach-box")
def reach_box(setup: Setup) -> Case:
    """Reachability cost on a 3-D lattice."""
    return _reach(setup, SCENES["box"](setup), 5e-3)
