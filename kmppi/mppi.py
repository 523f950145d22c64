"""Model predictive path integral control: sample, bound, evaluate, weigh, update, repeat."""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from kmppi.parameterization import PerStep, make_parameterization
from kmppi.types import ControlPlan, MPPISettings, Objective, Rollouts
from kmppi.weights import perturbation_cost, sample_weights

Generators = torch.Generator | Sequence[torch.Generator]
"""One generator for a whole batch of scenes, or one for each scene."""


class MPPI:
    """Sampling MPC over control points: MPPI with one a step, KMPPI with a few and a kernel between (RUMI, IV-I).

    SMPPI samples the changes from step to step instead.

    Holds settings and matrices only; the plan goes in and comes out. Plans of a batch of scenes go in as one; with a
    generator each, a row is what the scene gives alone, up to the rounding of sums in another order.

    Args:
        settings: horizon, knots, noise, temperature, limits.
        control_dim: dimensions A of a control.
        dtype: of plans and samples.
        device: of plans and samples.

    Raises:
        ValueError: `control_dim` does not fit the settings, or the knots' kernel matrix is close to singular.
    """

    def __init__(
        self,
        settings: MPPISettings,
        control_dim: int,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> None:
        if control_dim < 1:
            raise ValueError(f"Expected control_dim to be 1 or more, got {control_dim}")
        if not dtype.is_floating_point:
            raise ValueError(f"Expected dtype to be a floating one, such as torch.float32, got {dtype}")
        self.settings = settings
        self.control_dim = control_dim
        self.dtype = dtype
        self.device = torch.device(device)
        self.parameterization = make_parameterization(settings)
        self.control_min = self._per_dimension("control_min", settings.control_min)
        self.control_max = self._per_dimension("control_max", settings.control_max)
        self.noise_variance = self._per_dimension("noise_variance", settings.noise_variance)
        self._noise_std = self.noise_variance.sqrt()
        self._matrix = self.parameterization.matrix.to(self.device, dtype)
        self._shifts: dict[int, Tensor] = {}

    def from_knots(self, knots: Float[Tensor, "*b S A"]) -> ControlPlan:
        """The plan of given control points (*b, S, A), bounded.

        Raises:
            ValueError: they have another shape, or are not finite where that can be seen without a wait.
        """
        expected = (self.parameterization.knots, self.control_dim)
        if tuple(knots.shape[-2:]) != expected:
            raise ValueError(
                f"Expected knots to have shape (*b, S, A) with (S, A) = {expected}, got {tuple(knots.shape)}"
            )
        # on a GPU nobody waits for a look: what is not finite gives weights of NaN
        if knots.device.type != "cuda" and not bool(torch.isfinite(knots).all()):
            raise ValueError(f"Expected finite knots, got {knots[~torch.isfinite(knots)][0].item()} among them")
        bounded = self._bound_knots(knots.to(self.device, self.dtype))
        return ControlPlan(bounded, self.controls(bounded))

    def initial(self, *, generator: Generators) -> ControlPlan:
        """A plan of bounded noise, to improve by `settings.warmup_iterations` before it is executed (RUMI, IV-G).

        Args:
            generator: one for one scene, or as many as there are scenes.
        """
        batch = () if isinstance(generator, torch.Generator) else (len(generator),)
        return self.from_knots(self._noise(batch, 1, generator)[..., 0, :, :])

    def controls(self, knots: Float[Tensor, "*k S A"]) -> Float[Tensor, "*k H A"]:
        """Controls (*k, H, A) of knots (*k, S, A), clipped: between knots within the limits a curve may leave them."""
        if isinstance(self.parameterization, PerStep):
            return self._bound(knots)
        # one product for all samples: `matrix @ knots` would do one for each
        return self._bound(torch.einsum("hs,...sa->...ha", self._matrix, knots))

    def shift(self, plan: ControlPlan, executed: int) -> ControlPlan:
        """The same plan, `executed` controls later (RUMI, IV-G), as the parameterization says (its `shift_matrix`).

        MPPI appends zeros and SMPPI holds the last control; KMPPI moves knots along their curve, which decays to zero.

        Raises:
            ValueError: `executed` is negative.
        """
        if executed < 0:
            raise ValueError(f"Expected executed to be 0 or more, got {executed}")
        if executed not in self._shifts:
            self._shifts[executed] = self.parameterization.shift_matrix(executed).to(self.device, self.dtype)
        return self.from_knots(self._shifts[executed] @ plan.knots.to(self.device, self.dtype))

    @torch.no_grad()
    def plan(
        self,
        plan: ControlPlan,
        objective: Objective,
        *,
        proposals: Float[Tensor, "*b P S A"] | None = None,
        iterations: int | None = None,
        should_stop: Callable[[], bool] | None = None,
        generator: Generators,
    ) -> tuple[ControlPlan, Rollouts]:
        """Improve a plan.

        Args:
            plan: what to sample around, from `initial`, `shift` or an earlier call.
            objective: costs (*b, K) of controls (*b, K, H, A) within the limits; lower is better.
            proposals: knots (*b, P, S, A) of further nominal plans, such as a network's, which are evaluated first: the
                best of them and of `plan` is what is sampled around.
            iterations: how often to sample and update; `settings.iterations` unless given.
            should_stop: asked between iterations; on True the plan so far is returned. One iteration is always done.
            generator: all randomness of the samples, of each scene where there are several; it may live on another
                device.

        Returns:
            the new plan and the samples of the last iteration.

        Raises:
            NonFiniteCostsError: no sample of an iteration of a scene has a finite cost.
            ValueError: an argument or the objective's answer has the wrong shape.
        """
        iterations = self.settings.iterations if iterations is None else iterations
        if iterations < 1:
            raise ValueError(f"Expected iterations to be 1 or more, got {iterations}")
        plan = self.from_knots(plan.knots)
        if proposals is not None:
            plan = self._best(plan, self.from_knots(proposals), objective)
        for done in range(1, iterations + 1):
            plan, rollouts = self._iterate(plan, objective, done, generator)
            if done < iterations and should_stop is not None and should_stop():
                break
        return plan, rollouts

    def _best(self, plan: ControlPlan, proposals: ControlPlan, objective: Objective) -> ControlPlan:
        """The plan of least cost, of one and of several others (*b, P); the one where no cost is finite."""
        knots = torch.cat((plan.knots.unsqueeze(-3), proposals.knots), -3)
        controls = torch.cat((plan.controls.unsqueeze(-3), proposals.controls), -3)
        costs = self._evaluate(objective, controls)
        least = torch.where(costs.isfinite(), costs, torch.inf).argmin(-1)[..., None, None, None]
        return ControlPlan(*(of.take_along_dim(least, -3).squeeze(-3) for of in (knots, controls)))

    def _iterate(
        self, plan: ControlPlan, objective: Objective, done: int, generator: Generators
    ) -> tuple[ControlPlan, Rollouts]:
        settings = self.settings
        noise = self._noise(plan.knots.shape[:-2], settings.samples, generator)
        if settings.include_nominal:
            noise[..., 0, :, :] = 0.0
        nominal = plan.knots.unsqueeze(-3)
        knots = self._bound_knots(nominal + noise)
        controls = self.controls(knots)
        costs = self._evaluate(objective, controls)
        weighed = costs
        if settings.change_cost > 0:
            weighed = costs + settings.change_cost * controls.diff(dim=-2).square().sum((-2, -1))
        perturbation = None
        if settings.perturbation_cost:
            # the noise that was left after clipping is the one that was rolled out
            perturbation = perturbation_cost(plan.knots, knots - nominal, self.noise_variance, settings.temperature)
        weights = sample_weights(
            weighed, settings.temperature, cost_scale=settings.cost_scale, perturbation=perturbation
        )
        ess = weights.square().sum(-1).reciprocal().to(self.dtype)
        weights = weights.to(self.dtype)
        updated = (weights.unsqueeze(-2) @ knots.flatten(-2)).view_as(plan.knots)
        return self.from_knots(updated), Rollouts(controls, costs, weights, ess, done)

    def _evaluate(self, objective: Objective, controls: Float[Tensor, "*b K H A"]) -> Float[Tensor, "*b K"]:
        costs = objective(controls)
        expected = tuple(controls.shape[:-2])
        if tuple(costs.shape) != expected or not costs.is_floating_point():
            raise ValueError(
                f"Expected the objective to return one floating cost a sample, shape {expected}, "
                f"got shape {tuple(costs.shape)} of {costs.dtype}"
            )
        return costs.to(self.device)

    def _noise(self, batch: Sequence[int], count: int, generator: Generators) -> Float[Tensor, "*b count S A"]:
        shape = (count, self.parameterization.knots, self.control_dim)
        if isinstance(generator, torch.Generator):
            drawn = self._drawn((*batch, *shape), generator)
        elif len(batch) == 1 and batch[0] == len(generator):
            drawn = torch.stack([self._drawn(shape, one) for one in generator])
        else:
            raise ValueError(
                f"Expected one generator, or one for each scene of a batch {tuple(batch)}, got {len(generator)}"
            )
        return drawn.to(self.device) * self._noise_std

    def _drawn(self, shape: Sequence[int], generator: torch.Generator) -> Tensor:
        return torch.randn(tuple(shape), generator=generator, dtype=self.dtype, device=generator.device)

    def _bound(self, values: Float[Tensor, "*k A"]) -> Float[Tensor, "*k A"]:
        return torch.clamp(values, self.control_min, self.control_max)

    def _bound_knots(self, knots: Float[Tensor, "*k S A"]) -> Float[Tensor, "*k S A"]:
        return self.parameterization.bound(knots, self.control_min, self.control_max)

    def _per_dimension(self, name: str, value: float | tuple[float, ...]) -> Float[Tensor, "A"]:
        values = value if isinstance(value, tuple) else (value,)
        if len(values) not in (1, self.control_dim):
            raise ValueError(
                f"Expected {name} to be one number or one for each of {self.control_dim} control dimensions, "
                f"got {len(values)}"
            )
        return torch.tensor(values, dtype=self.dtype, device=self.device).expand(self.control_dim).clone()
