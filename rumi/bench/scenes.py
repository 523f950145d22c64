"""The scenes that are timed: a mug known up to its turn, planar, and a box known roughly, in 3-D."""

from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rumi.bench.case import Setup
from rumi.fields.workspace import Workspace
from rumi.seeding import split
from rumi.tasks.rummage.scenes import large_handled_mug
from sdf import se3, so3
from sdf.object_model import ObjectModel, box_model
from sdf.primitives import Mug

HEIGHT_M = 0.045
CENTRE = (0.45, 0.0)


@dataclass(frozen=True, eq=False)
class FieldScene:
    """A belief over an object and the points at which something is asked about it.

    Attributes:
        name: of the object.
        model: the object.
        world_T_object: (N, 4, 4), particles.
        log_weights: (N,), normalised, not all equal.
        workspace: the lattice of points.
    """

    name: str
    model: ObjectModel
    world_T_object: Float[Tensor, "N 4 4"]
    log_weights: Float[Tensor, "N"]
    workspace: Workspace

    @property
    def points(self) -> Float[Tensor, "V 3"]:
        """The lattice's points, metres."""
        return self.workspace.points

    @property
    def pairs(self) -> int:
        """Pairs of a particle and a point."""
        return len(self.world_T_object) * len(self.workspace)

    @property
    def what(self) -> str:
        """Its size in words."""
        kind = "planar" if self.workspace.planar else "3-D"
        return f"{self.name}, {len(self.world_T_object)} poses x {len(self.workspace)} points, {kind}"


def mug_scene(setup: Setup) -> FieldScene:
    """The tasks' mug, upright, its place known to 1 cm and its yaw to 30 degrees, over 81 x 81 points of one height."""
    count = setup.size(100, 6)
    random = split(0, "bench/mug")
    spread = torch.tensor([0.01, 0.01, 0.5])
    place = torch.tensor([*CENTRE, 0.0]) + spread * torch.randn(count, 3, generator=random)
    bounds = torch.tensor([[0.0, -0.4, HEIGHT_M], [0.8, 0.4, HEIGHT_M]])
    workspace = Workspace.from_bounds(bounds, 0.05 if setup.tiny else 0.01, planar_height=HEIGHT_M)
    weights = torch.log_softmax(torch.randn(count, generator=random), -1)
    return _on(setup, FieldScene("mug", _mug(setup.tiny), se3.from_planar(place), weights, workspace))


def box_scene(setup: Setup) -> FieldScene:
    """A cracker box, its place known to 1 cm and its turn to 11 degrees about each axis, over 41 x 41 x 11 points."""
    count = setup.size(100, 6)
    random = split(0, "bench/box")
    turn = so3.exp(0.2 * torch.randn(count, 3, generator=random))
    place = torch.tensor([*CENTRE, 0.1]) + 0.01 * torch.randn(count, 3, generator=random)
    bounds = torch.tensor([[0.0, -0.4, 0.0], [0.8, 0.4, 0.2]])
    workspace = Workspace.from_bounds(bounds, 0.1 if setup.tiny else 0.02)
    weights = torch.log_softmax(torch.randn(count, generator=random), -1)
    return _on(setup, FieldScene("box", _box(setup.tiny), se3.make(turn, place), weights, workspace))


SCENES = {"mug": mug_scene, "box": box_scene}


@dataclass(frozen=True, eq=False)
class ViewScene:
    """Points of space that were seen free or on the surface of a box, and poses to hold against them.

    Attributes:
        model: the object.
        world_T_object: (N, 4, 4), about the true pose.
        points: (M, 3), metres, in the world; free ones first.
        semantics: (M,).
        free: number of free points.
    """

    model: ObjectModel
    world_T_object: Float[Tensor, "N 4 4"]
    points: Float[Tensor, "M 3"]
    semantics: Int[Tensor, "M"]
    free: int


def view_scene(setup: Setup) -> ViewScene:
    """2000 free points within 5 cm of a box's own bounds and 300 on its near side; 100 poses about the true one."""
    from sensors.semantics import Semantics

    free, surface, count = setup.size(2000, 60), setup.size(300, 20), setup.size(100, 6)
    random = split(0, "bench/view")
    model = _box(setup.tiny)
    low, high = model.exact.bounds
    around = low - 0.05 + (high - low + 0.1) * torch.rand(20 * free, 3, generator=random)
    around = around[model.exact.distance(around) > 0.005][:free]
    near = model.surface_points[model.surface_normals[:, 0] < 0.5]
    near = near[torch.randperm(len(near), generator=random)[:surface]]
    truth = se3.make(so3.exp(torch.tensor([0.1, -0.2, 0.4])), torch.tensor([0.02, -0.01, 0.03]))
    poses = truth @ se3.make(
        so3.exp(0.15 * torch.randn(count, 3, generator=random)), 0.01 * torch.randn(count, 3, generator=random)
    )
    points = se3.apply(truth, torch.cat((around, near)))
    semantics = torch.tensor([int(Semantics.FREE)] * len(around) + [int(Semantics.SURFACE)] * len(near))
    to = setup.device
    return ViewScene(
        model if to.type == "cpu" else model.to(to), poses.to(to), points.to(to), semantics.to(to), len(around)
    )


@cache
def _mug(tiny: bool) -> ObjectModel:
    # its walls are 4 mm thick
    return large_handled_mug() if not tiny else _coarse_mug()


def _coarse_mug() -> ObjectModel:
    from sdf.object_model import object_model
    from sdf.symmetry import Symmetries

    return object_model("mug", Mug(wall=0.01), Symmetries.none(), spacing=0.005)


@cache
def _box(tiny: bool) -> ObjectModel:
    return box_model(spacing=0.01 if tiny else 0.002)


def _on(setup: Setup, scene: FieldScene) -> FieldScene:
    to = setup.device
    if to.type == "cpu":  # as it is: the peers' tables are kept by the model
        return scene
    return FieldScene(
        scene.name,
        scene.model.to(to),
        scene.world_T_object.to(to),
        scene.log_weights.to(to),
        scene.workspace.to(to),
    )
