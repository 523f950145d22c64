"""What is known of every workspace point under a belief: semantics, information, the surface's normal."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.bench import peers
from rumi.bench.case import Case, Setup, Target, Variant, case, largest_difference
from rumi.bench.scenes import SCENES, FieldScene
from rumi.fields.information import InformationMode, InformationSettings, information_field
from rumi.fields.normal import expected_normal
from sensors.semantics import semantics_probability

_VALUE = ("CachedSDF", "ComposedSDF")
_GRADIENT = ("CachedSDF with gradient", "ComposedSDF with gradient")
_LIMITS_S = {"mug": (12e-3, 3e-3), "box": (110e-3, 10e-3)}
_NORMAL = ("CachedSDF", "ComposedSDF")


def plain_formula(
    distance: Float[Tensor, "N V"], log_weights: Float[Tensor, "N"], mode: InformationMode
) -> tuple[Float[Tensor, "V 3"], Float[Tensor, "V"]]:
    """Semantics and information as one writes them down from the paper (V.E, Eqs 4-6, 23, 27).

    The paper's field (`surrogate`) with lambda = 2 and C = 10, or the mutual information (`sensor_mi`).
    """
    weights = log_weights.exp()
    each = semantics_probability(distance)
    semantics = (weights[:, None, None] * each).sum(0)
    if mode == "sensor_mi":
        entropy = -torch.xlogy(semantics, semantics).sum(-1)
        own = -torch.xlogy(each, each).sum(-1)
        return semantics, entropy - (weights[:, None] * own).sum(0)
    costs = torch.stack((10.0 * (-distance).clamp_min(0), 10.0 * distance.clamp_min(0), distance.abs()), -1)
    return semantics, (semantics * 2.0 * (weights[:, None, None] * costs).sum(0)).sum(-1)


def _field(setup: Setup, scene: FieldScene, mode: InformationMode) -> Case:
    poses, log_weights, points = scene.world_T_object, scene.log_weights, scene.points
    lean, every = InformationSettings(mode), InformationSettings(mode, tail=0.0)

    def field(settings: InformationSettings) -> Callable[[], tuple[Tensor, ...]]:
        return lambda: information_field(scene.model.sdf, poses, log_weights, points, settings)

    variants = (*setup.ours(field(lean)), *setup.ours(field(every), "all points"))
    if setup.peers:
        look_ups = (peers.cached_lookup, peers.composed_lookup)
        for names, gradient in ((_VALUE, False), (_GRADIENT, True)):
            for name, look_up in zip(names, look_ups, strict=True):
                run = look_up(scene.model, poses, points, gradient=gradient)
                variants += (Variant(name, _with_formula(run, log_weights, mode), "peer"),)
    targets = [Target(v, at_most_s=s) for v, s in zip(("torch", "numba"), _LIMITS_S[scene.name], strict=True)]
    if mode == "surrogate":
        targets += [
            Target("numba", at_least=8.0, against=_VALUE),
            Target("numba", at_least=14.0, against=_GRADIENT),
            Target("numba", at_least=20.0, against=_GRADIENT, goal=True),
        ]
    kind = "the paper's surrogate" if mode == "surrogate" else "mutual information, the default"
    return Case(
        f"semantics and information ({kind}): {scene.what}",
        variants,
        (*_VALUE, "torch"),
        scene.pairs,
        "pair",
        tuple(targets),
        largest_difference,
        5e-5,  # the tail that is left out, and rounding
        remarks=setup.remarks,
        left_out=setup.left_out,
    )


def _with_formula(
    look_up: Callable[[], tuple[Tensor, Tensor | None]], log_weights: Tensor, mode: InformationMode
) -> Callable[[], tuple[Tensor, Tensor]]:
    return lambda: plain_formula(look_up()[0], log_weights, mode)


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
    if setup.peers:
        weights = log_weights.exp()
        cached = peers.cached_lookup(scene.model, poses, points, gradient=True)
        composed = peers.composed_lookup(scene.model, poses, points, gradient=True)

        def turned() -> Tensor:
            slope = cached()[1]
            assert slope is not None
            return (weights[:, None, None] * (slope @ poses[:, :3, :3].mT)).sum(0)

        def summed() -> Tensor:
            slope = composed()[1]
            assert slope is not None
            return (weights[:, None, None] * slope).sum(0)

        variants += tuple(Variant(name, run, "peer") for name, run in zip(_NORMAL, (turned, summed), strict=True))
    return Case(
        f"mean outward normal, at every point: {scene.what}",
        variants,
        (*_NORMAL, "torch"),
        scene.pairs,
        "pair",
        (),
        largest_difference,
        # a gradient is that of the cell that a point falls in, which rounding decides at a node
        2e-2,
        remarks=setup.remarks,
        left_out=setup.left_out,
    )


@case("normal-mug")
def normal_mug(setup: Setup) -> Case:
    """The mug's expected normals."""
    return _normal(setup, SCENES["mug"](setup))


@case("normal-box")
def normal_box(setup: Setup) -> Case:
    """The box's expected normals."""
    return _normal(setup, SCENES["box"](setup))
