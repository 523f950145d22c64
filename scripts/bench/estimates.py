"""Errors of the belief and of the information field over the settings that their cost depends on."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.initialise import InitialiseSettings
from rumi.fields.information import InformationSettings, WorkspaceFields, information_field
from rumi.fields.workspace import Workspace
from rumi.metrics.likelihood import negative_log_likelihood
from rumi.metrics.pose_error import pose_error
from rumi.seeding import generator, split
from scripts.bench.belief_error import CoarseReference
from scripts.bench.nearest import NearestGrid
from scripts.bench.posteriors import reference_posterior, stand_ins
from scripts.bench.reference import GridPosterior
from scripts.bench.situations import Followed, Situation, follow
from scripts.store import Figures, Settings, Store, median_seconds
from sdf import backend, se3
from sdf.base import SDF
from sdf.grid_sdf import GridSDF

PARTICLES = (10, 30, 100, 300, 1000)
SDF_M = (0.001, 0.002, 0.003, 0.005)
LATTICE_M = (0.005, 0.010, 0.020)
_PROBES = 1500
_STAND_INS = 50_000
_MARGIN_M = 0.02


@dataclass(frozen=True)
class Estimate:
    """What a belief and its field are worked out with.

    Attributes:
        source: poses of the "filter", or independent "draws" from the reference, which no filter of as many
            particles does better than by more than luck.
        particles: P.
        sdf_m: spacing of the tabulated SDF.
        lattice_m: spacing of the workspace.
        look_up: into the SDF.
        precision: of the numbers; "half" keeps the SDF's table in 16 bits and computes in 32.
        starts: of the first belief.
        polished: of these, how many are polished.
    """

    source: Literal["filter", "draws"] = "filter"
    particles: int = 100
    sdf_m: float = 0.002
    lattice_m: float = 0.010
    look_up: Literal["trilinear", "nearest"] = "trilinear"
    precision: Literal["float32", "float64", "half"] = "float32"
    starts: int = InitialiseSettings.starts
    polished: int = InitialiseSettings.polished

    @property
    def dtype(self) -> torch.dtype:
        """Of the arithmetic."""
        return torch.float64 if self.precision == "float64" else torch.float32


def belief_estimates(quick: bool) -> list[Estimate]:
    """The settings whose beliefs are compared."""
    if quick:
        return [Estimate(), Estimate(particles=30), Estimate(source="draws")]
    found = [Estimate(particles=count) for count in PARTICLES]
    found += [Estimate(source="draws", particles=count) for count in PARTICLES]
    found += [Estimate(sdf_m=spacing) for spacing in SDF_M]
    found += [Estimate(precision="float64"), Estimate(precision="half")]
    found += [Estimate(starts=starts) for starts in (250, 500, 1000, 4000)]
    found += [Estimate(starts=500, polished=100)]
    return list(dict.fromkeys(found))


def field_estimates(quick: bool) -> list[Estimate]:
    """The settings whose fields are compared."""
    if quick:
        return [Estimate(), Estimate(particles=30), Estimate(lattice_m=0.020), Estimate(look_up="nearest")]
    found = [Estimate(particles=count, lattice_m=lattice) for count in PARTICLES for lattice in LATTICE_M]
    found += [Estimate(sdf_m=spacing, lattice_m=lattice) for spacing in SDF_M for lattice in LATTICE_M]
    found += [
        Estimate(source="draws", particles=count, lattice_m=lattice) for count in PARTICLES for lattice in LATTICE_M
    ]
    found += [Estimate(particles=count, precision="float64") for count in PARTICLES]
    for count in PARTICLES:
        found += [Estimate(particles=count, look_up="nearest"), Estimate(particles=count, precision="half")]
    return list(dict.fromkeys(found))


class ReferenceField(NamedTuple):
    """Semantics and information of probe points under the reference.

    Attributes:
        points: (V, 3), metres, anywhere about the object at the tool's height.
        semantics: (V, 3).
        information: (V,), nats.
        uncertainty: greatest difference, nats, between the fields of the two halves of the stand-ins.
    """

    points: Float[Tensor, "V 3"]
    semantics: Float[Tensor, "V 3"]
    information: Float[Tensor, "V"]
    uncertainty: float


@dataclass(eq=False)
class Bench:
    """A situation with its references, and the beliefs that were worked out in it.

    Args:
        here: the situation.
        folder: that keeps references.
        enough: total variation at which the reference is fine enough.
    """

    here: Situation
    folder: Path
    enough: float = 0.01
    _tables: dict[float, GridSDF] = field(default_factory=dict)
    _beliefs: dict[Any, Followed] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.posterior: GridPosterior = reference_posterior(self.here, self.folder, self.enough)
        self.coarse = CoarseReference(self.posterior.planar, self.posterior.log_weights.exp())
        self.field = reference_field(self.here, self.posterior, self.folder, f"{self.enough:g}")

    def sdf(self, estimate: Estimate) -> GridSDF:
        """The tabulated SDF of an estimate."""
        if estimate.sdf_m not in self._tables:
            self._tables[estimate.sdf_m] = GridSDF.from_sdf(self.here.model.exact, estimate.sdf_m)
        table = self._tables[estimate.sdf_m]
        values = table.values.half() if estimate.precision == "half" else table.values
        return GridSDF(
            values.to(estimate.dtype),
            (table.origin[0], table.origin[1], table.origin[2]),
            table.spacing,
            table.bounds.to(estimate.dtype),
            outer=table.outer,
            outer_spacing=table.outer_spacing,
        )

    def belief(self, estimate: Estimate, seed: int) -> Followed:
        """The filter's belief with an estimate's settings; worked out once."""
        key = (replace(estimate, lattice_m=0.0, look_up="trilinear"), seed)
        if key not in self._beliefs:
            start = InitialiseSettings(starts=estimate.starts, polished=estimate.polished)
            self._beliefs[key] = follow(
                self.here, self.sdf(estimate), particles=estimate.particles, seed=seed, start=start
            )
        return self._beliefs[key]

    def forget(self) -> None:
        """Forget all beliefs, so that they are worked out again."""
        self._beliefs.clear()

    def poses(self, estimate: Estimate, seed: int) -> tuple[Tensor, Tensor]:
        """Poses (N, 4, 4) in the attached frame and log-weights (N)."""
        if estimate.source == "filter":
            belief = self.belief(estimate, seed).belief
            return belief.attached_T_object, belief.log_weights
        planar = self.posterior.drawn(estimate.particles, generator=split(seed, "draws")).to(estimate.dtype)
        return se3.from_planar(planar), planar.new_full((len(planar),), -math.log(len(planar)))


def reference_field(here: Situation, posterior: GridPosterior, folder: Path, name: str) -> ReferenceField:
    """The field of the reference posterior at random points, by exact distances; kept in the folder."""
    path = folder / f"field-{here.name.replace('/', '-')}-{here.digest}-{name}.npz"
    if not path.exists():
        centre = (posterior.log_weights.exp()[:, None] * posterior.planar).sum(0)[:2]
        half = here.model.radius + _MARGIN_M
        share = torch.rand(_PROBES, 2, generator=generator(0), dtype=torch.float64)
        points = torch.cat((centre + half * (2 * share - 1), share.new_full((_PROBES, 1), here.spec.height_m)), -1)
        settings = InformationSettings(tail=0.0)
        log_weights = torch.full((_STAND_INS // 2,), -math.log(_STAND_INS // 2), dtype=torch.float64)
        halves = [
            information_field(
                here.model.exact, stand_ins(posterior, len(log_weights), offset), log_weights, points, settings
            )
            for offset in (0.25, 0.75)
        ]
        semantics, information = (0.5 * (a + b) for a, b in zip(*halves, strict=True))
        apart = (halves[0].information - halves[1].information).abs().max()
        arrays = {"points": points, "semantics": semantics, "information": information, "uncertainty": apart}
        np.savez(path, **{name: tensor.numpy() for name, tensor in arrays.items()})
    with np.load(path) as kept:
        points, semantics, information = (torch.from_numpy(kept[n]) for n in ("points", "semantics", "information"))
        return ReferenceField(points, semantics, information, float(kept["uncertainty"]))


def workspace(here: Situation, spacing: float) -> Workspace:
    """The task's workspace with another spacing."""
    low, high = ((*corner, here.spec.height_m) for corner in here.spec.bounds)
    return Workspace.from_bounds(torch.tensor([low, high]), spacing, planar_height=here.spec.height_m)


def belief_figures(bench: Bench, estimate: Estimate, seed: int) -> Figures:
    """Error of a belief, against the reference and, for its mode, against the truth."""
    poses, log_weights = bench.poses(estimate, seed)
    error = bench.coarse.error(se3.to_planar(poses), log_weights.exp())
    figures: Figures = dict(error._asdict())
    if estimate.source == "filter":
        followed, here = bench.belief(estimate, seed), bench.here
        truth = here.truth.to(poses)
        mode = se3.inverse(followed.belief.world_T_attached) @ followed.belief.mode()
        metres, radians = pose_error(mode, truth, here.model.symmetries)
        nll = negative_log_likelihood(
            poses.double(), log_weights.double(), truth.double(), here.model.surface_points, here.model.exact
        )
        figures |= {"position_error_m": float(metres), "rotation_error_rad": float(radians), "nll": float(nll)}
    return figures


def field_figures(bench: Bench, estimate: Estimate, seed: int) -> Figures:
    """Error of a field, worked out on a lattice and interpolated at the reference's points; nats and probability."""
    space = workspace(bench.here, estimate.lattice_m).to(estimate.dtype)
    points = bench.field.points.to(estimate.dtype)
    semantics, information = field_of(bench, estimate, seed)()
    found = space.grid(torch.cat((information[:, None], semantics), -1)).interpolate(points, outside=0.0).double()
    nats = (found[:, 0] - bench.field.information).abs()
    chance = (found[:, 1:] - bench.field.semantics).abs().amax(-1)
    return {
        "information_mean": float(nats.mean()),
        "information_max": float(nats.max()),
        "probability_mean": float(chance.mean()),
        "probability_max": float(chance.max()),
        "reference_mean": float(bench.field.information.mean()),
        "reference_max": float(bench.field.information.max()),
        "reference_uncertainty": bench.field.uncertainty,
    }


def field_of(bench: Bench, estimate: Estimate, seed: int) -> Callable[[], WorkspaceFields]:
    """What works out an estimate's field on its lattice."""
    poses, log_weights = bench.poses(estimate, seed)
    sdf: SDF = bench.sdf(estimate)
    if estimate.look_up == "nearest":
        sdf = NearestGrid(bench.sdf(estimate))
    points = workspace(bench.here, estimate.lattice_m).to(estimate.dtype).points
    return lambda: information_field(sdf, poses, log_weights, points)


def field_seconds(bench: Bench, estimate: Estimate, seed: int) -> Figures:
    """Time of an estimate's field; nearest look-up has a plain version only, which compares with the plain one."""
    work = field_of(bench, estimate, seed)
    seconds = median_seconds(work)
    with backend.force("torch"):
        return {"seconds": seconds, "plain_seconds": median_seconds(work)}


def belief_seconds(bench: Bench, estimate: Estimate, seed: int) -> Figures:
    """Time of an estimate's first belief and of its updates."""
    bench.forget()
    followed = bench.belief(estimate, seed)
    return {"first_s": followed.first_s, "step_s": followed.step_s}


def measure_estimates(store: Store, bench: Bench, seeds: tuple[int, ...], *, quick: bool) -> Iterator[bool]:
    """Do what is missing in one situation, one measurement at a time."""
    about: Settings = {"situation": bench.here.name, "points": bench.here.digest}
    for seed in seeds:
        for estimate in belief_estimates(quick):
            settings = {"part": "belief", **about, "seed": seed, **vars(estimate)}
            yield store.measure(settings, partial(belief_figures, bench, estimate, seed))
        for estimate in field_estimates(quick):
            settings = {"part": "field", **about, "seed": seed, **vars(estimate)}
            yield store.measure(settings, partial(field_figures, bench, estimate, seed))


def time_estimates(store: Store, bench: Bench, seed: int, *, quick: bool) -> Iterator[bool]:
    """Take the times that are missing; meant for a machine with nothing else to do."""
    about: Settings = {"situation": bench.here.name, "threads": torch.get_num_threads()}
    for estimate in belief_estimates(quick):
        if estimate.source == "filter":
            settings = {"part": "belief-time", **about, **vars(estimate)}
            yield store.measure(settings, partial(belief_seconds, bench, estimate, seed))
    for estimate in field_estimates(quick):
        if estimate.source == "filter":
            settings = {"part": "field-time", **about, **vars(estimate)}
            yield store.measure(settings, partial(field_seconds, bench, estimate, seed))
