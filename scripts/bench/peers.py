"""The public libraries that do parts of the same work, each in the modes that its own documents show.

Nothing else imports them. pytorch_volumetric imports open3d for meshes, which are not used here (its tables are
filled from this project's exact distances): where open3d cannot be loaded, an empty module stands in for it.
"""

import contextlib
import importlib
import importlib.util
import io
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rumi.bench.case import Setup
from sdf import se3
from sdf.extras import remedy
from sdf.object_model import ObjectModel
from sensors.semantics import Semantics

PACKAGES = ("pytorch_volumetric", "chsel", "pytorch_mppi")
INSTALL = remedy("peers")
SPACING_M = 0.0025
"""Of the peers' tables; this project's own have 2 mm and interpolate."""
PADDING_M = 0.1


@cache
def missing() -> str:
    """Why the peers cannot be timed; empty where they can."""
    lacking = [name for name in PACKAGES if importlib.util.find_spec(name) is None]
    if lacking:
        return f"not installed ({', '.join(lacking)}): {INSTALL}"
    _open3d()
    try:
        for name in PACKAGES:
            importlib.import_module(name)
    except Exception as error:  # whatever an import of others may raise
        return f"cannot be imported ({type(error).__name__}: {error}); {INSTALL} installs the versions that were tried"
    return ""


def available(setup: Setup) -> bool:
    """Whether they can be timed: they are installed, and the device is theirs too."""
    return not missing() and setup.device.type == "cpu"


def left_out(setup: Setup) -> tuple[str, ...]:
    """What a case says where they are not timed."""
    return () if available(setup) else (f"peers: {missing() or 'timed on the CPU only'}",)


def _open3d() -> None:
    try:
        importlib.import_module("open3d")
    except (ImportError, OSError):
        for name in [name for name in sys.modules if name.partition(".")[0] == "open3d"]:
            del sys.modules[name]
        sys.modules["open3d"] = ModuleType("open3d")


def _volumetric() -> Any:  # noqa: ANN401  (a module without types)
    assert not missing(), missing()
    return importlib.import_module("pytorch_volumetric")


@cache
def _cached_sdf(name: str, model: ObjectModel, spacing: float) -> Any:  # noqa: ANN401
    pv = _volumetric()
    exact = model.exact

    class Exact:
        """This project's exact distances, for the peer's table."""

        def __call__(self, points: Tensor, compute_grad: bool = True) -> tuple[Tensor, Tensor | None]:
            with torch.no_grad():
                rows = [exact(part) for part in points.reshape(-1, 3).split(1 << 18)]
            distance = torch.cat([row.distance for row in rows]).reshape(points.shape[:-1])
            return distance, torch.cat([row.gradient for row in rows]).reshape(points.shape)

        def surface_bounding_box(self, padding: float = 0.0, padding_ratio: float = 0.0) -> Tensor:
            low, high = exact.bounds
            margin = padding + padding_ratio * (high - low)
            return torch.stack((low - margin, high + margin), -1)

    box = Exact().surface_bounding_box(padding=PADDING_M).tolist()
    with tempfile.TemporaryDirectory() as folder:
        return pv.CachedSDF(name, spacing, box, Exact(), cache_path=str(Path(folder) / "cache.pkl"))


def cached_lookup(
    model: ObjectModel, world_T_object: Float[Tensor, "N 4 4"], points: Float[Tensor, "V 3"], *, gradient: bool
) -> Callable[[], tuple[Tensor, Tensor | None]]:
    """Distances (N, V), and gradients (N, V, 3) in the object frames, by pytorch_volumetric's CachedSDF, nearest node.

    The transform of the points is part of it.
    """
    import pytorch_kinematics as pk

    sdf = _cached_sdf(model.name, model, SPACING_M)
    count = len(world_T_object)

    def run() -> tuple[Tensor, Tensor | None]:
        points_o = pk.Transform3d(matrix=se3.inverse(world_T_object)).transform_points(points)
        value, slope = sdf(points_o, compute_grad=gradient)
        return value.view(count, -1), slope

    return run


def composed_lookup(
    model: ObjectModel, world_T_object: Float[Tensor, "N 4 4"], points: Float[Tensor, "V 3"], *, gradient: bool
) -> Callable[[], tuple[Tensor, Tensor | None]]:
    """The same by its ComposedSDF of one CachedSDF at a batch of transforms; gradients are in the world frame."""
    import pytorch_kinematics as pk

    pv = _volumetric()
    identity = pk.Transform3d(matrix=torch.eye(4)[None])
    sdf = pv.ComposedSDF([_cached_sdf(model.name, model, SPACING_M)], identity)
    batch = (len(world_T_object),)

    def run() -> tuple[Tensor, Tensor | None]:
        sdf.set_transforms(pk.Transform3d(matrix=se3.inverse(world_T_object)), batch_dim=batch)
        value, slope = sdf(points, compute_grad=gradient)
        return value, slope

    return run


def chsel_cost(
    model: ObjectModel,
    world_T_object: Float[Tensor, "N 4 4"],
    free: Float[Tensor, "F 3"],
    surface: Float[Tensor, "S 3"],
    *,
    direct: bool,
    free_scale: float = 10.0,
) -> tuple[Callable[[], Tensor], Callable[[], tuple[Tensor, Tensor]], int]:
    """The pose cost of chsel: value alone, value and gradient to the transforms, and how many points it asks about.

    Args:
        model: the object.
        world_T_object: poses.
        free: points in free space, world frame.
        surface: points on the surface, world frame.
        direct: ask the SDF about every free point (VolumetricDoubleDirectCost, the form of RUMI's Eq 3); else
            chsel's default (VolumetricDirectSDFCost), which asks a voxel grid about points inside the model.
        free_scale: weight of the free points.
    """
    pv, chsel = _volumetric(), importlib.import_module("chsel")
    sdf = _cached_sdf(model.name, model, SPACING_M)
    known = pv.VoxelSet(surface, torch.zeros(len(surface)))
    # metres by which free points may be violated: none, or chsel's default
    threshold = 0.0 if direct else 0.01
    scales = {"surface_threshold": threshold, "scale_known_freespace": free_scale}
    if direct:
        cost = chsel.VolumetricDoubleDirectCost(pv.VoxelSet(free, torch.ones(len(free))), known, sdf, **scales)
        asked = len(free)
    else:
        box = torch.stack((free.amin(0) - threshold, free.amax(0) + threshold), -1).tolist()
        voxels = pv.VoxelGrid(0.01, box)
        voxels[free] = torch.ones(len(free))
        bounds = sdf.surface_bounding_box(padding=PADDING_M).numpy()
        # a coarse query, so that it has about as few interior points as with a small object
        cost = chsel.VolumetricDirectSDFCost(voxels, known, sdf, query_voxel_grid=pv.VoxelGrid(0.02, bounds), **scales)
        asked = len(cost.model_interior_points_orig)
    object_T_world = se3.inverse(world_T_object)
    ones = torch.ones(len(object_T_world))

    def value() -> Tensor:
        with torch.no_grad():
            found: Tensor = cost(object_T_world[:, :3, :3], object_T_world[:, :3, 3], ones)
            return found

    def value_and_gradient() -> tuple[Tensor, Tensor]:
        moving = object_T_world.clone().requires_grad_()
        found = cost(moving[:, :3, :3], moving[:, :3, 3], ones)
        (slope,) = torch.autograd.grad(found.sum(), moving)
        return found.detach(), slope

    return value, value_and_gradient, asked


def chsel_register(
    model: ObjectModel, points: Float[Tensor, "M 3"], semantics: Int[Tensor, "M"], seed: int, *, batch: int = 100
) -> Callable[[], Float[Tensor, "B 4 4"]]:
    """The registration of chsel with its test's settings, from random rotations about the points' middle.

    Gives `batch` poses. Beside the starts its random numbers are the global ones, which are left as they are.
    """
    import pytorch_kinematics as pk

    chsel = importlib.import_module("chsel")
    sdf = _cached_sdf(model.name, model, SPACING_M)
    kinds = [chsel.SemanticsClass.FREE, chsel.SemanticsClass.OCCUPIED, chsel.SemanticsClass.SURFACE]
    labels = torch.tensor([kind.value for kind in kinds])[semantics]
    touching = points[semantics != Semantics.FREE]

    def run() -> Tensor:
        with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
            random = torch.Generator().manual_seed(seed)
            start = torch.eye(4).repeat(batch, 1, 1)
            start[:, :3, :3] = pk.quaternion_to_matrix(
                torch.nn.functional.normalize(torch.randn(batch, 4, generator=random), dim=-1)
            )
            start[:, :3, 3] = -(start[:, :3, :3] @ touching.mean(0)) + model.sdf.bounds.mean(0)
            peer = chsel.CHSEL(sdf, points, labels, qd_iterations=100, do_qd=True, savedir=folder)
            found, _ = peer.register(iterations=1, batch=batch, initial_tsf=start)
            return se3.inverse(chsel.solution_to_world_to_link_matrix(found).detach().to(points))

    return run


def down_sample(points: Float[Tensor, "M 3"], spacing: float) -> Float[Tensor, "K 3"]:
    """pytorch_volumetric's thinning of points to voxel centres, which the paper's information cost uses."""
    thinned: Tensor = _volumetric().voxel_down_sample(points, spacing)
    return thinned


def make_kmppi(
    step: Callable[[Tensor, Tensor], Tensor],
    cost: Callable[[Tensor, Tensor], Tensor],
    *,
    states: int,
    variance: Float[Tensor, "A"],
    samples: int,
    horizon: int,
    knots: int,
    scale: float,
    temperature: float,
    generator: torch.Generator,
) -> Any:  # noqa: ANN401  (a class without types)
    """pytorch_mppi's KMPPI with controls in [-1, 1]; `command(state)` plans and gives the next control.

    It draws from the generator instead of torch's global one; nothing else of it is changed.
    """
    assert not missing(), missing()
    module = importlib.import_module("pytorch_mppi.mppi")

    class Seeded(module.KMPPI):  # type: ignore[name-defined]
        def _sample_noise(self, shape: tuple[int, ...]) -> Tensor:
            drawn = torch.randn(*shape, self.nu, generator=generator, dtype=self.dtype)
            return drawn * self._noise_sigma_sqrt_diag + self.noise_mu

    return Seeded(
        step,
        cost,
        states,
        torch.diag(variance),
        num_samples=samples,
        horizon=horizon,
        lambda_=temperature,
        u_min=-torch.ones_like(variance),
        u_max=torch.ones_like(variance),
        num_support_pts=knots,
        kernel=module.RBFKernel(sigma=scale),
    )
