"""References by long chains: held to the grid where there is one, and beliefs in SE(3) held to them."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.initialise import InitialiseSettings, initialise
from rumi.belief.particles import PoseBelief
from rumi.fields.information import InformationSettings, WorkspaceFields, information_field
from rumi.seeding import split
from scripts.bench.belief_error import CoarseReference
from scripts.bench.box_view import BoxView, box_density, box_view, face_up, field_points
from scripts.bench.chains import (
    Chains,
    ChainSettings,
    coordinates,
    effective_size,
    folded,
    split_r_hat,
    tempered_chains,
)
from scripts.bench.reference import boltzmann, grid_posterior
from scripts.bench.situations import Situation
from scripts.store import Figures, Store, clock
from sdf import se3
from sdf.grid_sdf import GridSDF
from sensors.discrepancy import Discrepancy
from sensors.observation import concatenate
from sensors.semantics import Semantics

_COARSE = (0.004, 0.004, math.radians(20.0))
_BIN_RAD = 0.26


@dataclass(frozen=True)
class BoxEstimate:
    """A first belief in SE(3).

    Attributes:
        particles: P.
        starts: poses that the descent starts from.
        sdf_m: spacing of the tabulated SDF.
    """

    particles: int = 100
    starts: int = 2000
    sdf_m: float = 0.002


def box_estimates(quick: bool) -> list[BoxEstimate]:
    """The settings that are compared."""
    if quick:
        return [BoxEstimate()]
    found = [BoxEstimate(particles=count) for count in (10, 30, 100, 300, 1000)]
    found += [BoxEstimate(starts=count) for count in (250, 500, 1000, 4000)]
    return list(dict.fromkeys(found + [BoxEstimate(sdf_m=spacing) for spacing in (0.001, 0.003, 0.005)]))


def chains_on_the_plane(here: Situation, settings: ChainSettings) -> Figures:
    """Chains in SE(2) against the grid, on a thinned view (as many points as chains can look at for long).

    With a grid to draw from, the distance that as many independent draws have on average is known too.
    """
    memory = here.memory.to(dtype=torch.float64)
    surface = memory.of_class(Semantics.SURFACE).nonzero()[:, 0]
    middle = memory.points[surface].mean(0)
    close = (memory.points - middle).norm(dim=-1) < 0.10
    free = (memory.of_class(Semantics.FREE) & close).nonzero()[:, 0]
    some = concatenate([memory[surface[::8]], memory[free[::24]]])
    # sharper, since the points are fewer: about as narrow a posterior as that of all
    density = boltzmann(here.model.exact, some, peakiness=16.0)
    (x, y), half = middle[:2].tolist(), 0.07
    grid = grid_posterior(density, (x - half, y - half), (x + half, y + half), enough=0.015)
    low, high = (torch.tensor((x + s * half, y + s * half, 0.0), dtype=torch.float64) for s in (-1, 1))
    noise = split(0, "plane chains")
    chains = tempered_chains(lambda poses: density(se3.to_planar(poses)), low, high, "SE(2)", settings, generator=noise)
    visited = se3.to_planar(chains.poses.reshape(-1, 4, 4))
    coarse = CoarseReference(grid.planar, grid.log_weights.exp(), _COARSE)
    figures = convergence(chains, coordinates(chains.poses, "SE(2)"))

    def error(planar: Float[Tensor, "N 3"]) -> float:
        return coarse.error(planar, planar.new_full((len(planar),), 1.0 / len(planar))).total_variation

    size = round(figures["effective_size"])
    draws = [error(grid.drawn(size, generator=split(seed, "draws"))) for seed in range(10)]
    yaw = coarse.error(visited, visited.new_full((len(visited),), 1.0 / len(visited)))
    return figures | {
        "observed_points": len(some),
        "grid_cells": len(grid.planar),
        "grid_change": grid.change,
        "total_variation": yaw.total_variation,
        "total_variation_yaw": yaw.total_variation_yaw,
        "total_variation_of_draws": sum(draws) / len(draws),
    }


def convergence(chains: Chains, values: Float[Tensor, "C S D"]) -> Figures:
    """Largest R-hat and least effective size over some coordinates, and how the chains moved."""
    return {
        "r_hat": float(split_r_hat(values).max()),
        "effective_size": float(effective_size(values).min()),
        "kept": values.shape[0] * values.shape[1],
        "accepted": chains.accepted,
        "least_swapped": float(chains.swapped.min()),
    }


class BoxBench:
    """The box's view with its reference by chains.

    Args:
        settings: of the chains.
        folder: that keeps what they visited.
    """

    def __init__(self, settings: ChainSettings, folder: Path) -> None:
        self.view: BoxView = box_view()
        path = folder / f"box-{settings.chains}x{settings.steps}.npz"
        if not path.exists():
            made = tempered_chains(
                box_density(self.view),
                self.view.low,
                self.view.high,
                "SE(3)",
                settings,
                generator=split(0, "box chains"),
            )
            folder.mkdir(parents=True, exist_ok=True)
            np.savez(path, poses=made.poses.numpy(), accepted=made.accepted, swapped=made.swapped.numpy())
        with np.load(path) as kept:
            self.chains = Chains(
                torch.from_numpy(kept["poses"]), float(kept["accepted"]), torch.from_numpy(kept["swapped"])
            )
        self.faces = torch.bincount(face_up(self.chains.poses).flatten(), minlength=3) / len(
            self.chains.poses.flatten(0, 1)
        )
        self.points = field_points()
        self.halves = [self._field(self.chains.poses[start::2].reshape(-1, 4, 4)) for start in (0, 1)]

    def convergence(self) -> Figures:
        """Of the chains, folded by the box's symmetry, and of which face is up."""
        upright = folded(self.chains.poses, self.view.model.symmetries.rotations, torch.eye(3, dtype=torch.float64))
        values = torch.cat((coordinates(upright, "SE(3)"), torch.nn.functional.one_hot(face_up(upright), 3)), -1)
        apart = (self.halves[0].information - self.halves[1].information).abs()
        between = {"field_halves_mean": float(apart.mean()), "field_halves_max": float(apart.max())}
        return convergence(self.chains, values) | {"faces": self.faces} | between

    def figures(self, estimate: BoxEstimate, seed: int) -> Figures:
        """Error of a first belief and of its field."""
        begun = clock()
        belief = self._belief(estimate, seed)
        first_s = clock() - begun
        mass = torch.zeros(3).index_add_(0, face_up(belief.attached_T_object), belief.weights)
        own = self._field(belief.attached_T_object.double(), belief.log_weights.double())
        reference = 0.5 * (self.halves[0].information + self.halves[1].information)
        semantics = 0.5 * (self.halves[0].semantics + self.halves[1].semantics)
        nats = (own.information - reference).abs()
        return {
            "faces_total_variation": 0.5 * float((mass - self.faces).abs().sum()),
            "modes_lost": int((mass < 1e-6).sum()),
            "information_mean": float(nats.mean()),
            "information_max": float(nats.max()),
            "probability_mean": float((own.semantics - semantics).abs().amax(-1).mean()),
            "reference_mean": float(reference.mean()),
            "first_s": first_s,
        }

    def _belief(self, estimate: BoxEstimate, seed: int) -> PoseBelief:
        view = self.view
        table = GridSDF.from_sdf(view.model.exact, estimate.sdf_m).float()
        cost = Discrepancy(table, view.model.radius, free_scale=80.0, tolerance=0.001)
        noise = split(seed, "box starts")
        turn = torch.linalg.qr(torch.randn(estimate.starts, 3, 3, generator=noise, dtype=torch.float64)).Q
        turn = turn * turn.det()[:, None, None]  # reflections become rotations
        place = view.low + (view.high - view.low) * torch.rand(estimate.starts, 3, generator=noise, dtype=torch.float64)
        settings = InitialiseSettings(particles=estimate.particles, starts=estimate.starts, bin_rad=_BIN_RAD)
        return initialise(
            cost,
            view.observation.to(dtype=torch.float32),
            se3.make(turn, place).float(),
            "SE(3)",
            2.0,
            settings,
            generator=split(seed, "initialise"),
        )

    def _field(self, poses: Float[Tensor, "N 4 4"], log_weights: Tensor | None = None) -> WorkspaceFields:
        even = poses.new_full((len(poses),), -math.log(len(poses)))
        return information_field(
            self.view.model.exact,
            poses,
            even if log_weights is None else log_weights,
            self.points,
            InformationSettings(tail=0.0),
        )


def measure_boxes(store: Store, here: Situation, folder: Path, *, quick: bool) -> Iterator[bool]:
    """Do what is missing, one measurement at a time."""
    settings = ChainSettings(burn_in=1000, steps=2000) if quick else ChainSettings()
    about: dict[str, Any] = {"chains": settings.chains, "steps": settings.steps}
    yield store.measure(
        {"part": "chains", "search": "SE(2)", "situation": here.name, "points": here.digest, **about},
        lambda: chains_on_the_plane(here, replace(settings, inverse_temperatures=(1.0, 0.5, 0.2, 0.07, 0.02))),
    )
    bench = BoxBench(settings, folder)
    yield store.measure({"part": "chains", "search": "SE(3)", **about}, bench.convergence)
    for seed in (1000,) if quick else (1000, 1001, 1002):
        for estimate in box_estimates(quick):
            yield store.measure(
                {"part": "box-belief", "seed": seed, **vars(estimate), **about},
                partial(bench.figures, estimate, seed),
            )
