"""How far posed objects are from what was seen, and which way is downhill."""

import torch
from torch import Tensor

from rumi.bench.case import Case, Setup, Variant, case, largest_difference
from rumi.bench.scenes import ViewScene, view_scene
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation


def _what(scene: ViewScene) -> str:
    surface = len(scene.points) - scene.free
    return f"{len(scene.world_T_object)} poses x ({scene.free} free + {surface} surface points), box, 3-D"


@case("discrepancy")
def discrepancy(setup: Setup) -> Case:
    """The discrepancy of a batch of poses."""
    scene, cost, view = _scene(setup)

    def run() -> Tensor:
        with torch.no_grad():
            return cost(scene.world_T_object, view)

    variants = setup.ours(run)
    return Case(
        f"discrepancy: {_what(scene)}",
        variants,
        items=len(scene.world_T_object) * len(scene.points),
        item="pair",
        error=largest_difference,
        tolerance=1e-3,  # of sums of 2300 terms
    )


@case("discrepancy-gradient")
def discrepancy_gradient(setup: Setup) -> Case:
    """The discrepancy with its gradient to the poses by autograd, as the peers give it."""
    scene, cost, view = _scene(setup)
    poses = scene.world_T_object.clone().requires_grad_()

    def run() -> tuple[Tensor, Tensor]:
        value = cost(poses, view)
        (gradient,) = torch.autograd.grad(value.sum(), poses)
        return value.detach(), gradient

    variants: tuple[Variant, ...] = (Variant("torch", run, version="torch"),)
    return Case(
        f"discrepancy with gradient: {_what(scene)}",
        variants,
        items=len(scene.world_T_object) * len(scene.points),
        item="pair",
        error=largest_difference,
        tolerance=1e-3,
    )


def _scene(setup: Setup) -> tuple[ViewScene, Discrepancy, Observation]:
    scene = view_scene(setup)
    cost = Discrepancy(scene.model.sdf, scene.model.radius).to(setup.device)
    seen = torch.ones_like(scene.semantics, dtype=torch.bool)
    return scene, cost, Observation(scene.points, scene.semantics, seen, seen)
