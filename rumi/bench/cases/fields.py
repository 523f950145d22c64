"""What is known of every workspace point under a belief: semantics, information, the surface's normal."""

from collections.abc import Callable

from torch import Tensor

from rumi.bench.case import Case, Setup, case, largest_difference
from rumi.bench.scenes import SCENES, FieldScene
from rumi.fields.information import InformationMode, InformationSettings, information_field
from rumi.fields.normal import expected_normal


def _field(setup: Setup, scene: FieldScene, mode: InformationMode) -> Case:
    poses, log_weights, points = scene.world_T_object, scene.log_weights, scene.points
    lean, every = InformationSettings(mode), InformationSettings(mode, tail=0.0)

    def field(settings: InformationSettings) -> Callable[[], tuple[Tensor, ...]]:
        return lambda: information_field(scene.model.sdf, poses, log_weights, points, settings)

    variants = (*setup.ours(field(lean)), *setup.ours(field(every), "all points"))
    kind = "the paper's surrogate" if mode == "surrogate" else "mutual information, the default"
    return Case(
        f"semantics and information ({kind}): {scene.what}",
        variants,
        items=scene.pairs,
        item="pair",
        error=largest_difference,
        tolerance=5e-5,  # the tail that is left out, and rounding
    )


@case("field-mug")
def field_mug(setup: Setup) -> Case:
    """The paper's field of the mug."""
    return _field(setup, SCENES["mug"](setup), "surrogate")


@case("field-box")
def field_box(setup: Setup) -> Case:
    """The paper's field of the box."""
    return _field(setup, SCENES["box"](setup), "surrogate")


@case("field-mug-mi")
def field_mug_mi(setup: Setup) -> Case:
    """The default field of the mug."""
    return _field(setup, SCENES["mug"](setup), "sensor_mi")


@case("field-box-mi")
def field_box_mi(setup: Setup) -> Case:
    """The default field of the box."""
    return _field(setup, SCENES["box"](setup), "sensor_mi")


def _normal(setup: Setup, scene: FieldScene) -> Case:
    poses, log_weights, points = scene.world_T_object, scene.log_weights, scene.points
    variants = setup.ours(lambda: expected_normal(scene.model.sdf, poses, log_weights, points))
    return Case(
        f"mean outward normal, at every point: {scene.what}",
        variants,
        items=scene.pairs,
        item="pair",
        error=largest_difference,
        # a gradient is that of the cell that a point falls in, which rounding decides at a node
        tolerance=2e-2,
    )


@case("normal-mug")
def normal_mug(setup: Setup) -> Case:
    """The mug's expected normals."""
    return _normal(setup, SCENES["mug"](setup))


@case("normal-box")
def normal_box(setup: Setup) -> Case:
    """The box's expected normals."""
    return _normal(setup, SCENES["box"](setup))
