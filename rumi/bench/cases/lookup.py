"""Signed distances of workspace points from one object at many poses."""

from rumi.bench.case import Case, Setup, case, largest_difference
from rumi.bench.scenes import SCENES, FieldScene
from sdf.posed import posed_distance, posed_query


def _lookup(setup: Setup, scene: FieldScene, *, gradient: bool) -> Case:
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


@case("distance-mug")
def distance_mug(setup: Setup) -> Case:
    """Distances from the mug."""
    return _lookup(setup, SCENES["mug"](setup), gradient=False)


@case("distance-box")
def distance_box(setup: Setup) -> Case:
    """Distances from the box."""
    return _lookup(setup, SCENES["box"](setup), gradient=False)


@case("gradient-mug")
def gradient_mug(setup: Setup) -> Case:
    """Distances from the mug with their gradients."""
    return _lookup(setup, SCENES["mug"](setup), gradient=True)


@case("gradient-box")
def gradient_box(setup: Setup) -> Case:
    """Distances from the box with their gradients."""
    return _lookup(setup, SCENES["box"](setup), gradient=True)
