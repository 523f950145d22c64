"""GPVR: go where a Gaussian-process implicit surface is least sure of itself (RUMI, V-H)."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from kmppi import MPPI, ControlPlan
from rumi.baselines.implicit_surface import (
    Hyperparameters,
    Labelled,
    fit,
    labelled,
    library,
    predictive_variance,
)
from rumi.belief.particles import PoseBelief
from rumi.dynamics.base import PushRollouts
from rumi.fields.information import WorkspaceFields
from rumi.planning.rummaging import RummagingPolicy, RummagingSettings
from rumi.planning.tool import Tool
from rumi.planning.trajectory_cost import mean_over_rollouts
from rumi.planning.types import Plan, Scene
from rumi.planning.worth import Worth, gathering
from sdf.voxel_grid import VoxelGrid
from sensors.observation import in_world
from sensors.semantics import Semantics


@dataclass(frozen=True)
class GPVRSettings:
    """Settings of GPVR beside those of planner and push model, which it shares with RUMI.

    Attributes:
        refit_steps: of the optimiser, for each plan, from where the last plan's ended.
        learning_rate: of the optimiser; the paper gives none.
        tolerance: gradient of the likelihood a point below which a refit ends early, most often at once where little is
            new; 0, the paper's, takes all steps.
        least_lengthscale: lower bound of the process's lengthscale, in spacings of that lattice: a shorter one calls
             the space between them unknown. 0, the paper's as far as it says, has no bound.
        free_probability: workspace points that are free with more than this probability are data, which tells the
            process of the object's shape.
        free_spacing: lattice over the workspace that free points are thinned on, in spacings of the workspace's own.
        max_points: data in all; 0 keeps all surface points (RUMI does, and takes seconds on a large GPU).
        discount: beta of Eq 37.
    """

    refit_steps: int = 50
    learning_rate: float = 0.1
    tolerance: float = 0.02
    least_lengthscale: float = 0.0
    free_probability: float = 0.99
    free_spacing: float = 7.0
    max_points: int = 500
    discount: float = 0.99

    def __post_init__(self) -> None:
        """Refuse what has no meaning."""
        for name in ("refit_steps", "max_points", "tolerance", "least_lengthscale"):
            if getattr(self, name) < 0:
                raise ValueError(f"Expected {name} to be 0 or more, got {getattr(self, name)}")
        for name in ("learning_rate", "free_spacing"):
            if not getattr(self, name) > 0:
                raise ValueError(f"Expected {name} to be more than 0, got {getattr(self, name)}")
        for name in ("free_probability", "discount"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"Expected {name} in [0, 1], got {getattr(self, name)}")


class VarianceCost:
    """Minus the variance that the sensing points meet, step by step: cells once a step (RUMI, Eq 37).

    Args:
        variance: (X, Y, Z), 0 or more, taken as 0 outside; a point meets the cell around the node next to it.
        tool: whose sensing points meet it.
        discount: beta, by which each step counts less than the one before.
    """

    def __init__(self, variance: VoxelGrid, tool: Tool, discount: float) -> None:
        self.discount = discount
        self._met = gathering(variance, tool)

    def __call__(self, rollouts: PushRollouts) -> Float[Tensor, "K"]:
        """Cost of each control sequence: the mean over its rollouts."""
        return mean_over_rollouts(rollouts, lambda paths: self.of_paths(*paths.riding()))

    def of_paths(
        self, configurations: Float[Tensor, "R H Q"], displacements: Float[Tensor, "R H 3"]
    ) -> Float[Tensor, "R"]:
        """Cost of each path; the field rides with the object."""
        steps = configurations.shape[:2]
        each = self._met(configurations.flatten(0, 1)[:, None], displacements.flatten(0, 1)[:, None]).view(steps)
        return each @ self.discount ** torch.arange(steps[1], dtype=each.dtype, device=each.device)


class GPVRPolicy(RummagingPolicy):
    """KMPPI over the variance of a Gaussian-process implicit surface. A `Policy`; holds settings only.

    The process is fitted to what has been observed so far, surface points with label 0 and free ones with label 1, and
    to the workspace points that the belief holds for free. Its variance is worked out on the workspace's lattice once a
    plan, and looked up in the rollouts. Its hyperparameters start where those of the plan before ended. There is no
    cost for pushing the object out of reach.

    Args:
        settings: of the planner and the push model; its own costs are not used.
        gp: of the process and its cost.
        greedy: look at the next position only, as the work that GPVR comes from did (and the paper left).

    Raises:
        UsageError: the library of Gaussian processes is not installed.
    """

    worth_stage = "gp_fit"

    def __init__(
        self, settings: RummagingSettings | None = None, gp: GPVRSettings | None = None, *, greedy: bool = False
    ) -> None:
        library()
        settings = settings or RummagingSettings()
        if greedy:
            # the best of the samples about standing still
            alone = replace(
                settings.mppi,
                horizon=1,
                knots=None,
                temperature=1e-6,
                cost_scale="std",
                warmup_iterations=1,
                iterations=1,
                perturbation_cost=False,
            )
            settings = replace(settings, mppi=alone)
        super().__init__(None, settings)
        self.gp = gp or GPVRSettings()
        self.greedy = greedy

    def worth(self, belief: PoseBelief, scene: Scene, fields: WorkspaceFields, previous: Plan | None) -> Worth:
        """What motions are worth: the variance that they meet."""
        settings, kept = self.gp, None if previous is None else previous.info.get("gp_hyperparameters")
        data = self.data(belief, scene, fields)
        start = None if kept is None else Hyperparameters(*kept)
        found = fit(
            data,
            start,
            steps=settings.refit_steps,
            learning_rate=settings.learning_rate,
            tolerance=settings.tolerance,
            least_lengthscale_m=settings.least_lengthscale * settings.free_spacing * scene.workspace.spacing,
        )
        variance = predictive_variance(data, found, scene.workspace.points)
        share = (variance / variance.amax()).to(fields.information)
        grid = scene.workspace.grid(share)
        whole = gathering(grid, scene.tool)
        return Worth(
            VarianceCost(grid, scene.tool, settings.discount),
            lambda configurations, displacements: -whole(configurations, displacements),
            {"variance": share},
            {"gp_hyperparameters": list(found), "gp_points": len(data.points)},
            {"information_cost": 1.0, "reachability_cost": 1.0},
        )

    def data(self, belief: PoseBelief, scene: Scene, fields: WorkspaceFields) -> Labelled:
        """What the process is fitted to.

        Raises:
            ValueError: the scene does not have the points observed so far.
        """
        if scene.observed is None:
            raise ValueError(
                "Expected scene.observed, which the process is fitted to, got None: give all points so far"
            )
        settings, workspace = self.gp, scene.workspace
        observed = in_world(scene.observed, belief.world_T_attached)
        surface = observed.points[observed.of_class(Semantics.SURFACE)]
        known = workspace.points[fields.semantics[..., 0] > settings.free_probability]
        free = torch.cat((observed.points[observed.of_class(Semantics.FREE)], known.to(surface)))
        spacing = settings.free_spacing * workspace.spacing
        return labelled(surface, free, spacing, settings.max_points or None, bounds=workspace.bounds)

    def _start(
        self, mppi: MPPI, previous: Plan | None, executed: int, generator: torch.Generator
    ) -> tuple[ControlPlan, int]:
        if not self.greedy:
            return super()._start(mppi, previous, executed, generator)
        return mppi.from_knots(torch.zeros(1, mppi.control_dim)), 1
