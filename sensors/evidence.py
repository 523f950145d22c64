"""What a reading says about every pose: the family of evidence."""

from dataclasses import dataclass, replace
from typing import Protocol, Self, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from sdf import se3
from sdf.posed import posed_distance
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation
from sensors.semantics import SemanticSensor


@runtime_checkable
class Evidence(Protocol):
    """Anything that has a log-likelihood for poses of the object; a filter update sums them."""

    def log_likelihood(self, world_T_object: Float[Tensor, "*b N 4 4"]) -> Float[Tensor, "*b N"]:
        """Log-likelihood of each pose up to a constant, nats; never NaN."""
        ...

    def moved(self, motion: Float[Tensor, "*b 4 4"]) -> Self:
        """The same evidence after the object moved by a known world motion."""
        ...


class KeptEvidence(Evidence, Protocol):
    """Evidence that a belief keeps, and takes along."""

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Self:
        """On another device, in a floating dtype."""
        ...


def in_attached_frame(observation: Observation, world_T_attached: Float[Tensor, "*b 4 4"]) -> Observation:
    """The observation with its world-fixed points carried to where they are in the attached frame now."""
    if len(observation) == 0 or bool(observation.attached.all()):
        return observation
    carried = se3.apply(se3.inverse(world_T_attached), observation.points)
    return replace(observation, points=carried.where(~observation.attached[..., None], observation.points))


@dataclass(frozen=True)
class SemanticPoints:
    """Semantic points under RUMI's Boltzmann posterior: log L = -lambda C^(X, T) (Eq 10).

    Attributes:
        observation: the points.
        discrepancy: C^.
        world_T_attached: (*b, 4, 4), where the attached points' frame is.
        peakiness: lambda, nats per metre of discrepancy.
    """

    observation: Observation
    discrepancy: Discrepancy
    world_T_attached: Float[Tensor, "*b 4 4"]
    peakiness: float = 2.0

    def log_likelihood(self, world_T_object: Float[Tensor, "*b N 4 4"]) -> Float[Tensor, "*b N"]:
        """-lambda C^ of each pose."""
        attached_T_object = se3.inverse(self.world_T_attached)[..., None, :, :] @ world_T_object
        return -self.peakiness * self.discrepancy(
            attached_T_object, in_attached_frame(self.observation, self.world_T_attached)
        )

    def moved(self, motion: Float[Tensor, "*b 4 4"]) -> Self:
        """Attached points go with the object, fixed ones stay."""
        return replace(self, world_T_attached=motion @ self.world_T_attached)


@dataclass(frozen=True)
class SensorPoints:
    """Semantic points under the sensor model's own likelihood: log L = sum of log p(s | signed distance) (V.E).

    Attributes:
        observation: the points.
        discrepancy: gives the signed distance function.
        world_T_attached: (*b, 4, 4), where the attached points' frame is.
        sensor: the sensor model.
        floor: least probability of a point, so that one outlier does not refute a pose for good.
    """

    observation: Observation
    discrepancy: Discrepancy
    world_T_attached: Float[Tensor, "*b 4 4"]
    sensor: SemanticSensor
    floor: float = 1e-6

    def log_likelihood(self, world_T_object: Float[Tensor, "*b N 4 4"]) -> Float[Tensor, "*b N"]:
        """Sum over points of log p(semantics | signed distance)."""
        attached_T_object = se3.inverse(self.world_T_attached)[..., None, :, :] @ world_T_object
        here = in_attached_frame(self.observation, self.world_T_attached)
        probability = self.sensor(posed_distance(self.discrepancy.sdf, attached_T_object, here.points))
        index = here.semantics[..., None, :, None].expand(*probability.shape[:-1], 1)
        log = probability.gather(-1, index)[..., 0].clamp_min(self.floor).log()
        return log.where(here.valid[..., None, :], log.new_zeros(())).sum(-1)

    def moved(self, motion: Float[Tensor, "*b 4 4"]) -> Self:
        """Attached points go with the object, fixed ones stay."""
        return replace(self, world_T_attached=motion @ self.world_T_attached)
