"""The information that planned motions gather."""

import torch
from torch import Tensor

from rumi.bench import naive, peers
from rumi.bench.case import Case, Setup, Target, Variant, case, largest_difference
from rumi.bench.cases.rollouts import push_scene
from rumi.dynamics.tool_lookup import world_height
from rumi.planning.costs import information_cost
from sdf import se3

_LOOP, _THINNED = "torch.unique", "voxel_down_sample"


@case("trajectory")
def trajectory(setup: Setup) -> Case:
    """Trajectory information."""
    scene = push_scene(setup)
    once = scene.roll_out()
    q, moved = once.configurations[:, :, 1:].flatten(0, 1), once.displacements[:, :, 1:].flatten(0, 1)
    points, grid = world_height(scene.tool.info, scene.tool.height_m).to(q), scene.information

    def run() -> Tensor:
        return information_cost(grid, points, q, moved)

    def loop() -> Tensor:
        return -naive.gathered(grid, points, q, moved)

    some = setup.size(50, 2)

    def thinned() -> Tensor:
        costs = []
        for path, shift in zip(q[:some], moved[:some], strict=True):
            met = (se3.apply(se3.from_planar(path), points) - shift[:, None]).reshape(-1, 3)
            costs.append(-grid.interpolate(peers.down_sample(met, grid.spacing)).sum())
        return torch.stack(costs)

    variants = (*setup.ours(run), Variant(_LOOP, loop, "naive", note="one rollout after the other"))
    if setup.peers:
        variants += (
            Variant(
                _THINNED,
                thinned,
                "peer",
                share=some / len(q),
                note="one rollout after the other, on a lattice of each one's own",
            ),
        )
    return Case(
        f"trajectory information (Eq 29): {len(q)} rollouts x {q.shape[1]} actions x {len(points)} points",
        variants,
        (_LOOP,),
        items=len(q),
        item="rollout",
        targets=(
            Target("numba", at_most_s=5e-3),
            Target("numba", at_least=30.0, against=(_LOOP,)),
            Target("torch", at_most_s=40e-3),
        ),
        error=largest_difference,
        # a point on the border of two cells may fall on either side
        tolerance=0.05 * float(grid.values.max()) + 1e-4,
        facts={"error": "nats", "information in all, nats": round(float(grid.values.sum()), 3)},
        left_out=setup.left_out,
    )
