"""GPVR policy: go where a Gaussian-process implicit surface has the greatest variance (RUMI, V-H)."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from kmppi import MPPI, ControlPlan
from rumi.belief.particles import PoseBelief
from rumi.clock import Now
from rumi.dynamics.base import PushDefaults, PushRollouts
from rumi.fields.information import WorkspaceFields
from rumi.planning.implicit_surface import (
    Hyperparameters,
    Labelled,
    fit,
    labelled,
    next_to_nodes,
    predictive_variance,
    prepare,
)
from rumi.planning.objective import Objective, gathering, mean_over_rollouts
from rumi.planning.plan_budget import PlanBudget
from rumi.planning.policy import Plan, Scene
from rumi.planning.rummaging import RummagingPolicy, RummagingSettings
from rumi.robot.tool import Tool
from sdf.bounds import Checked, CountOr0, NotNegative, Positive, Share
from sdf.voxel_grid import VoxelGrid
from sensors.observation import in_world
from sensors.semantics import Semantics

# data of the first look of a plan with a budget, and the least that there is
_FEW_POINTS = 50
# data that would take as long as what of a step of the fit, and of the variance, does not depend on their number
_STEP_FIXED, _VARIANCE_FIXED = 150, 50
# of the time that is left, what the fit and the variance may take, and steps that the fit should have time for
_FIT_SHARE, _VARIANCE_SHARE, _FIT_STEPS = 0.3, 0.15, 5


@dataclass(frozen=True)
class GPVRSettings(Checked):
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

    refit_steps: CountOr0 = 50
    learning_rate: Positive = 0.1
    tolerance: NotNegative = 0.02
    least_lengthscale: NotNegative = 0.0
    free_probability: Share = 0.99
    free_spacing: Positive = 7.0
    max_points: CountOr0 = 500
    discount: Share = 0.99


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
        return mean_over_rollouts(rollouts, lambda paths: self.of_paths(*paths.in_object_frame()))

    def of_paths(
        self, configurations: Float[Tensor, "R H Q"], displacements: Float[Tensor, "R H 3"]
    ) -> Float[Tensor, "R"]:
        """Cost of each path; the field rides with the object."""
        steps = configurations.shape[:2]
        each = self._met(configurations.flatten(0, 1)[:, None], displacements.flatten(0, 1)[:, None]).view(steps)
        weight = self.discount ** torch.arange(steps[1], dtype=each.dtype, device=each.device)
        # a product with the vector would add up otherwise for other numbers of paths
        return (each * weight).sum(-1)


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
        now: the clock that budgets are held against.

    Raises:
        UsageError: the library of Gaussian processes is not installed.
    """

    objective_stage = "gp_fit"

    def __init__(
        self,
        settings: RummagingSettings | None = None,
        gp: GPVRSettings | None = None,
        *,
        greedy: bool = False,
        now: Now = time.perf_counter,
    ) -> None:
        prepare()
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
        super().__init__(None, settings, now=now)
        self.gp = gp or GPVRSettings()
        self.greedy = greedy

    def objective(
        self,
        belief: PoseBelief,
        scene: Scene,
        fields: WorkspaceFields,
        previous: Plan | None,
        budget: PlanBudget | None = None,
        suited: PushDefaults | None = None,
    ) -> Objective:
        """What motions are worth: the variance that they meet.

        Where there is no time for all, the process is fitted to fewer points, in fewer steps.
        """
        kept = None if previous is None else previous.info.get("gp_hyperparameters")
        start = None if kept is None else Hyperparameters(*kept)
        budget = budget or PlanBudget(None, self.now)
        begun = budget.now()
        surface, free = self.observed(belief, scene, fields)
        budget.took("gp_points", 1.0, budget.now() - begun)
        made, few = None, self._few()
        if not budget.open and not budget.knows("gp_variance"):
            # what there is for sure; it also tells how long the work takes, since a step is not slower than this
            begun = budget.now()
            made = self._variance(labelled(surface, free, few), scene, start, budget, fitted=False)
            budget.took("gp_step", _square(made.points, _STEP_FIXED), budget.now() - begun)
        most = self._points_in_time(budget)
        if made is None or most is None or most >= made.points:
            most = None if most is None else max(most, few)
            made = self._variance(labelled(surface, free, most), scene, start, budget)
        begun = budget.now()
        share = (made.variance / made.variance.amax()).to(fields.information)
        grid = scene.workspace.grid(share)
        whole = gathering(grid, scene.tool)
        objective = Objective(
            VarianceCost(grid, scene.tool, self.gp.discount),
            lambda configurations, displacements: -whole(configurations, displacements),
            {"variance": share},
            {"gp_hyperparameters": list(made.found), "gp_points": made.points},
            {"information_cost": 1.0, "reachability_cost": 1.0},
        )
        budget.took("gp_cost", 1.0, budget.now() - begun)
        return objective

    def _variance(
        self, data: Labelled, scene: Scene, start: Hyperparameters | None, budget: PlanBudget, *, fitted: bool = True
    ) -> "_Fitted":
        """Fit the process, in as many steps as there is time for, and look at its variance on the lattice."""
        settings, count = self.gp, len(data.points)
        work = _square(count, _STEP_FIXED)
        in_time = budget.open or budget.expected("gp_step", work) <= _FIT_SHARE * budget.left()
        if fitted and not in_time:
            budget.ease("gp_step")
        found = fit(
            data,
            start,
            steps=settings.refit_steps if fitted and in_time else 0,
            learning_rate=settings.learning_rate,
            tolerance=settings.tolerance,
            least_lengthscale_m=settings.least_lengthscale * settings.free_spacing * scene.workspace.spacing,
            should_stop=None if budget.open else _stopper(budget, work),
        )
        begun = budget.now()
        variance = predictive_variance(data, found, scene.workspace.points)
        budget.took("gp_variance", _square(count, _VARIANCE_FIXED), budget.now() - begun)
        return _Fitted(found, variance, count)

    def _points_in_time(self, budget: PlanBudget) -> int | None:
        """How many points there is time for; None for all."""
        most = self.gp.max_points or None
        if budget.open:
            return most
        left, fits = max(budget.left() - budget.expected("gp_cost"), 0.0), math.inf
        for kind, share, fixed in (
            ("gp_variance", _VARIANCE_SHARE, _VARIANCE_FIXED),
            ("gp_step", _FIT_SHARE / _FIT_STEPS, _STEP_FIXED),
        ):
            each = budget.expected(kind)
            if each > 0:
                fits = min(fits, math.sqrt(max(share * left / each - fixed**2, 0.0)))
        if fits == math.inf:
            return most
        return int(fits) if most is None else min(int(fits), most)

    def _few(self) -> int:
        return min(_FEW_POINTS, self.gp.max_points or _FEW_POINTS)

    def _least_objective(self, budget: PlanBudget) -> float:
        variance = budget.expected("gp_variance", _square(self._few(), _VARIANCE_FIXED))
        return budget.expected("gp_points") + variance + budget.expected("gp_cost")

    def data(self, belief: PoseBelief, scene: Scene, fields: WorkspaceFields) -> Labelled:
        """What the process is fitted to where there is time for it, as many points as the settings say.

        Raises:
            ValueError: the scene does not have the points observed so far.
        """
        return labelled(*self.observed(belief, scene, fields), self.gp.max_points or None)

    def observed(
        self, belief: PoseBelief, scene: Scene, fields: WorkspaceFields
    ) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "F 3"]]:
        """All surface points so far in the world, and free ones, of the belief too, next to the nodes of a lattice.

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
        return surface, next_to_nodes(free, settings.free_spacing * workspace.spacing, workspace.bounds)

    def _start(
        self, mppi: MPPI, previous: Plan | None, executed: int, generator: torch.Generator
    ) -> tuple[ControlPlan, int]:
        if not self.greedy:
            return super()._start(mppi, previous, executed, generator)
        return mppi.from_knots(torch.zeros(1, mppi.control_dim)), 1


class _Fitted(NamedTuple):
    """A process and what it is unsure of.

    Attributes:
        found: its hyperparameters.
        variance: on the workspace's lattice.
        points: that it was fitted to.
    """

    found: Hyperparameters
    variance: Float[Tensor, "V"]
    points: int


def _square(count: int, fixed: int) -> float:
    """Work on so many points, in a unit of its own."""
    return float(count**2 + fixed**2)


def _stopper(budget: PlanBudget, work: float) -> Callable[[], bool]:
    """Asked after each step of a fit, whether there is no time for another."""
    last = budget.now()
    ends = last + _FIT_SHARE * max(budget.left(), 0.0)

    def stop() -> bool:
        nonlocal last
        now = budget.now()
        budget.took("gp_step", work, now - last)
        last = now
        return now + budget.expected("gp_step", work) > ends

    return stop
