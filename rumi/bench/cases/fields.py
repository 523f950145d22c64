"""What is known of every workspace point under a belief: semantics, information, the surface's normal."""

from collections.abc import Callable

from torch import Tensor

from rumi.bench.case import Case, Setup, cases, largest_difference
from rumi.bench.scenes import SCENES
from rumi.fields.information import InformationMode, InformationSettings, information_field
from rumi.fields.normal import expected_normal


@cases(
    {
        "field-mug": ("mug", "surrogate"),
        "field-box": ("box", "surrogate"),
        "field-mug-mi": ("mug", "sensor_mi"),
        "field-box-mi": ("box", "sensor_mi"),
    }
)
def field(setup: Setup, name: str, mode: InformationMode) -> Case:
    """The field of an object, the paper's or the default one."""
    scene = SCENES[name](setup)
    poses, log_weights, points = scene.world_T_object, scene.log_weights, scene.points
    lean, every = InformationSettings(mode), InformationSettings(mode, tail=0.0)

    def found(settings: InformationSettings) -> Callable[[], tuple[Tensor, ...]]:
        return lambda: information_field(scene.model.sdf, poses, log_weights, points, settings)

    variants = (*setup.ours(found(lean)), *setup.ours(found(every), "all points"))
    kind = "the paper's surrogate" if mode == "surrogate" else "mutual information, the default"
    return Case(
        f"semantics and information ({kind}): {scene.what}",
        variants,
        items=scene.pairs,
        item="pair",
        error=largest_difference,
        tolerance=5e-5,  # the tail that is left out, and rounding
    )


@cases({"normal-mug": ("mug",), "normal-box": ("box",)})
def normal(setup: Setup, name: str) -> Case:
    """An object's expected normals."""
    scene = SCENES[name](setup)
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
