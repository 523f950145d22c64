"""The information that planned motions gather."""

from torch import Tensor

from rumi.bench.case import Case, Setup, case, largest_difference
from rumi.bench.cases.rollouts import push_scene
from rumi.dynamics.tool_lookup import world_height
from rumi.planning.costs import information_cost


@case("trajectory")
def trajectory(setup: Setup) -> Case:
    """Trajectory information."""
    scene = push_scene(setup)
    once = scene.roll_out()
    q, moved = once.configurations[:, :, 1:].flatten(0, 1), once.displacements[:, :, 1:].flatten(0, 1)
    points, grid = world_height(scene.tool.info, scene.tool.height_m).to(q), scene.information

    def run() -> Tensor:
        return information_cost(grid, points, q, moved)

    return Case(
        f"trajectory information (Eq 29): {len(q)} rollouts x {q.shape[1]} actions x {len(points)} points",
        setup.ours(run),
        items=len(q),
        item="rollout",
        error=largest_difference,
        # a point on the border of two cells may fall on either side
        tolerance=0.05 * float(grid.values.max()) + 1e-4,
        facts={"error": "nats", "information in all, nats": round(float(grid.values.sum()), 3)},
    )
