"""Generalised-momentum observer: external joint torques, and contact signals of them.

M(q) a + bias(q, v) = torque + external. The generalised-momentum observer (De Luca and Mattone 2003; Haddadin, De Luca
and Albu-Schaeffer 2017) gives the external torque behind a first-order filter of gain K and needs no acceleration.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, Self, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sdf.bounds import Checked, Count, Positive
from sdf.check import check_finite, check_shape


class DynamicsTerms(NamedTuple):
    """Terms of a robot's equation of motion at a configuration.

    Attributes:
        mass: (*b, J, J), mass matrix, with the motors' inertia.
        bias: (*b, J), torques that Coriolis and centrifugal forces, gravity and known friction take, N m.
    """

    mass: Float[Tensor, "*b J J"]
    bias: Float[Tensor, "*b J"]


@runtime_checkable
class RobotDynamics(Protocol):
    """A model of a robot."""

    def __call__(self, position: Float[Tensor, "J"], velocity: Float[Tensor, "J"]) -> DynamicsTerms:
        """The terms at joint positions (rad or m) and velocities."""
        ...


class ObserverState(NamedTuple):
    """State of a momentum observer after a sample.

    Attributes:
        residual: (*b, J), the filtered external torque, N m.
        terms: of the dynamics at the sample.
        velocity: (*b, J), of the joints then.
    """

    residual: Float[Tensor, "*b J"]
    terms: DynamicsTerms
    velocity: Float[Tensor, "*b J"]


@dataclass(frozen=True)
class MomentumObserver(Checked):
    """The observer, in discrete time; it holds no state.

    Between two samples the momentum p = M v changes by the torques and by C^T v; with M and the bias in the middle of
    the samples that is, to second order in the step, external = mean M (v' - v) / step + mean bias - torque, for which
    neither C nor the derivative of M is needed. The filter is exact for an external torque that is constant between
    samples, whatever the step: residual' = residual + (1 - exp(-K step)) (external - residual).

    Attributes:
        gain: K, 1/s. A step of the external torque shows by 63 % after 1 / K.
    """

    gain: Positive = 25.0

    def start(self, terms: DynamicsTerms, velocity: Float[Tensor, "*b J"]) -> ObserverState:
        """Before anything was felt: a residual of 0."""
        return ObserverState(torch.zeros_like(velocity), terms, velocity)

    def step(
        self,
        state: ObserverState,
        terms: DynamicsTerms,
        velocity: Float[Tensor, "*b J"],
        torque: Float[Tensor, "*b J"],
        step_s: float | Float[Tensor, "*b"],
    ) -> ObserverState:
        """Take in one sample.

        Args:
            state: after the sample before.
            terms: of the dynamics at this sample.
            velocity: (*b, J), measured at this sample.
            torque: (*b, J), of the motors, at the joints, mean from the sample before to this one, N m.
            step_s: seconds between them, above 0.
        """
        external = external_torque(state.terms, state.velocity, terms, velocity, torque, step_s)
        return ObserverState(state.residual + self._share(step_s) * (external - state.residual), terms, velocity)

    def run(
        self, external: Float[Tensor, "K J"], steps_s: Float[Tensor, "K"], begin: Float[Tensor, "J"] | None = None
    ) -> Float[Tensor, "K J"]:
        """The filter over raw external torques (K, J), each over its own step; it begins at 0, or where it was."""
        share = -torch.expm1(-self.gain * steps_s.to(external))[:, None]
        if len(external) == 0:
            return external
        residual = torch.zeros_like(external[0]) if begin is None else begin
        found = []
        for raw, part in zip(external, share, strict=True):
            residual = torch.lerp(residual, raw, part)
            found.append(residual)
        return torch.stack(found)

    def covariance(
        self, mass: Float[Tensor, "J J"], torque_sd: float, velocity_sd: float, step_s: float
    ) -> Float[Tensor, "J J"]:
        """Of a residual at rest, from white noise of measured torques (N m) and velocities (rad/s), in the long run.

        With a = 1 - exp(-K step): a / (2 - a) torque_sd^2 + 2 a^2 / (2 - a) (velocity_sd / step)^2 M M^T. Readings are
        correlated by exp(-K step) from one to the next.
        """
        a = -math.expm1(-self.gain * step_s)
        eye = torch.eye(mass.shape[-1], dtype=mass.dtype, device=mass.device)
        jitter = 2.0 * a * a / (2.0 - a) * (velocity_sd / step_s) ** 2
        return a / (2.0 - a) * torque_sd**2 * eye + jitter * mass @ mass.mT

    def _share(self, step_s: float | Tensor) -> float | Tensor:
        if isinstance(step_s, Tensor):
            return -torch.expm1(-self.gain * step_s)[..., None]
        return -math.expm1(-self.gain * step_s)


def external_torque(
    before: DynamicsTerms,
    velocity_before: Float[Tensor, "*b J"],
    terms: DynamicsTerms,
    velocity: Float[Tensor, "*b J"],
    torque: Float[Tensor, "*b J"],
    step_s: float | Float[Tensor, "*b"],
) -> Float[Tensor, "*b J"]:
    """Mean external torque (*b, J) from one sample to the next, not filtered; see `MomentumObserver`."""
    step = step_s[..., None] if isinstance(step_s, Tensor) else step_s
    change = (velocity - velocity_before) / step
    pushed = (0.5 * (before.mass + terms.mass) @ change[..., None])[..., 0]
    return pushed + 0.5 * (before.bias + terms.bias) - torque


def residuals(
    dynamics: RobotDynamics,
    stamps: Float[Tensor, "K"],
    position: Float[Tensor, "K J"],
    velocity: Float[Tensor, "K J"],
    torque: Float[Tensor, "K J"],
    observer: MomentumObserver | None = None,
) -> Float[Tensor, "K J"]:
    """Residuals (K, J) of a whole recording; the first is 0.

    Args:
        dynamics: of the robot.
        stamps: (K,), seconds, each later than the one before.
        position: (K, J).
        velocity: (K, J).
        torque: (K, J), at each stamp; between two stamps their mean counts.
        observer: the filter.

    Raises:
        ValueError: stamps that do not rise, or values that are not finite.
    """
    check_shape("stamps", stamps, "(K,)")
    for name, value in (("stamps", stamps), ("position", position), ("velocity", velocity), ("torque", torque)):
        check_finite(name, value)
        if len(value) != len(stamps):
            raise ValueError(f"Expected {name} to have a row a stamp, {len(stamps)}, got {len(value)}")
    steps = stamps.diff()
    if bool((steps <= 0).any()):
        index = int((steps <= 0).nonzero()[0, 0])
        raise ValueError(
            f"Expected stamps that rise, got {float(stamps[index + 1])} s after {float(stamps[index])} s: sort the "
            "samples and drop those that came twice"
        )
    terms = [dynamics(*sample) for sample in zip(position, velocity, strict=True)]
    if len(terms) < 2:
        return torch.zeros_like(velocity)
    mass, bias = (torch.stack([getattr(one, name) for one in terms]).to(velocity) for name in ("mass", "bias"))
    raw = external_torque(
        DynamicsTerms(mass[:-1], bias[:-1]),
        velocity[:-1],
        DynamicsTerms(mass[1:], bias[1:]),
        velocity[1:],
        0.5 * (torque[1:] + torque[:-1]),
        steps.to(velocity),
    )
    found = (observer or MomentumObserver()).run(raw, steps)
    return torch.cat((torch.zeros_like(found[:1]), found))


@dataclass(frozen=True)
class TorqueThreshold(Checked):
    """Threshold of a contact signal, on the norm of the first joints' residual from its value at rest.

    The last joints' torques say little (their levers are short) and are as noisy.

    Attributes:
        threshold_nm: N m.
        joints: how many count, from the base on.
        rest: residual at rest without contact (the torque sensors' bias), N m; joints that are not given count as 0.
    """

    threshold_nm: Positive
    joints: Count = 5
    rest: tuple[float, ...] = ()

    @classmethod
    def above(
        cls, free: Float[Tensor, "*b J"], factor: float = 1.3, joints: int = 5, rest: Sequence[float] = ()
    ) -> Self:
        """A threshold so many times the largest norm of residuals (*b, J) of motions without contact.

        Raises:
            ValueError: no residual, or one that is not finite.
        """
        if free.numel() == 0:
            raise ValueError(f"Expected residuals of a motion without contact, got none, {tuple(free.shape)}")
        check_finite("free", free)
        own = cls(1.0, joints, tuple(rest))
        return replace(own, threshold_nm=factor * float(own.norm(free).amax()))

    def at_rest(self, residual: Float[Tensor, "K J"]) -> Self:
        """The same with the rest taken from readings (K, J) at rest.

        Raises:
            ValueError: no reading, or one that is not finite.
        """
        if len(residual) == 0:
            raise ValueError(f"Expected residuals at rest, got none, {tuple(residual.shape)}")
        check_finite("residual", residual)
        return replace(self, rest=tuple(residual.mean(0).tolist()))

    def norm(self, residual: Float[Tensor, "*b J"]) -> Float[Tensor, "*b"]:
        """What is compared with the threshold, N m."""
        count = min(self.joints, residual.shape[-1])
        rest = torch.zeros(residual.shape[-1]).to(residual)
        given = torch.tensor(self.rest, dtype=residual.dtype, device=residual.device)[: len(rest)]
        rest[: len(given)] = given
        return (residual - rest)[..., :count].norm(dim=-1)

    def contact(self, residual: Float[Tensor, "*b J"]) -> Bool[Tensor, "*b"]:
        """Contact signals (*b).

        Raises:
            ValueError: a residual that is not finite: it would read as a joint that felt nothing.
        """
        check_finite("residual", residual)
        return self.norm(residual) > self.threshold_nm
