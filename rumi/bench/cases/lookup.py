"""Signed distances of workspace points from one object at many poses."""

from rumi.bench.case import Case, Setup, cases, largest_difference
from rumi.bench.scenes import SCENES
from sdf.posed import posed_distance, posed_query


@cases(
    {
        "distance-mug": ("mug", False),
        "distance-box": ("box", False),
        "gradient-mug": ("mug", True),
        "gradient-box": ("box", True),
    }
)
def lookup(setup: Setup, name: str, gradient: bool) -> Case:
    """Distances from an object, with their gradients or without."""
    scene = SCENES[name](setup)
    sdf, poses, points = scene.model.sdf, scene.world_T_object, scene.points
    variants = setup.ours(lambda: posed_query(sdf, poses, points) if gradient else posed_distance(sdf, poses, points))
    what = "distance and gradient" if gradient else "distance"
    return Case(
        f"{what}: {scene.what}",
        variants,
        items=scene.pairs,
        item="pair",
        error=lambda found, reference: largest_difference(_distance(found), _distance(reference)),
        tolerance=1e-5,
    )


def _distance(found: object) -> object:
    return found[0] if isinstance(found, tuple) else found
