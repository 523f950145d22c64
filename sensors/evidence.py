"""Evidence: log-likelihoods of poses given measurements, and the measurement models that make it of readings.

A belief keeps evidence in the frame that rides with the object, where it stays true when the object moves.
"""

from dataclasses import dataclass, is_dataclass, replace
from typing import Protocol, Self, TypeVar, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from sdf import se3
from sdf.check import is_eager
from sdf.containers import container
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation
from sensors.reading import Reading, transfer

E = TypeVar("E")


@runtime_checkable
class Evidence(Protocol):
    """Log-likelihood of states given measurements; that of independent measurements adds up.

    Evidence that a belief keeps is a frozen dataclass, whose tensors go along with the belief (`EvidenceSet.to`).
    """

    def log_likelihood(self, states: Tensor, /) -> Tensor:
        """Log-likelihood of each state, up to a constant, nats; never NaN, 0 where nothing was measured.

        Args:
            states: (N, 4, 4), poses of the object in the frame of the measurements, (*b, N, 4, 4) where those are of
                as many scenes; or (N, ...), states of something fixed in whatever space a filter follows it.

        Returns:
            (*b, N).
        """
        ...


@runtime_checkable
class EvidenceModel(Protocol[E]):
    """Measurement model of one kind of sensing: gathers the evidence of its readings."""

    def update(self, evidence: E | None, reading: Reading, world_T_attached: Float[Tensor, "*b K 4 4"], /) -> E | None:
        """Evidence with what a reading adds; the same where it adds nothing, None where nothing ever was.

        Args:
            evidence: of all readings before.
            reading: of an action; its coordinates are the world's.
            world_T_attached: (*b, K, 4, 4), the frame that rides with the object, in which evidence is kept, at each
                instant of the reading.
        """
        ...


@container()
@dataclass(frozen=True)
class EvidenceSet:
    """Sum of the evidence of several kinds: an `Evidence`.

    Attributes:
        members: one of each kind, in the order in which they are summed; None where nothing was measured.

    Raises:
        TypeError: a member is no dataclass, so that its tensors could not be found.
    """

    members: tuple[Evidence | None, ...] = ()

    def __post_init__(self) -> None:
        """Refuse members whose tensors would be left behind."""
        for member in self.members:
            if member is not None and not is_dataclass(member):
                raise TypeError(f"Expected evidence as a dataclass, whose tensors can be moved, got {member!r}")

    def log_likelihood(self, states: Float[Tensor, "*b N 4 4"], /) -> Float[Tensor, "*b N"]:
        """Sum of the members' log-likelihoods of each pose, nats; 0 without any."""
        parts = [member.log_likelihood(states) for member in self.members if member is not None]
        total = parts[0] if parts else states.new_zeros(states.shape[:-2])
        for part in parts[1:]:
            total = total + part
        return total

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Self:
        """On another device, in a floating dtype; signed distance functions, which others share, stay as they are."""
        return replace(self, members=tuple(transfer(member, device, dtype) for member in self.members))


def gather(
    models: tuple[EvidenceModel, ...],
    evidence: EvidenceSet | None,
    reading: Reading,
    world_T_attached: Float[Tensor, "*b K 4 4"],
) -> EvidenceSet | None:
    """Evidence of all kinds with what a reading adds; None where nothing was measured, now or before.

    Args:
        models: of each kind, in the order of the set's members.
        evidence: of all readings before.
        reading: of an action.
        world_T_attached: (*b, K, 4, 4), see `EvidenceModel.update`.
    """
    before = () if evidence is None else evidence.members
    if len(before) > len(models):
        raise ValueError(f"Expected evidence of at most {len(models)} kinds, got {len(before)}: give the models of all")
    before = (*before, *[None] * (len(models) - len(before)))
    members = tuple(model.update(own, reading, world_T_attached) for model, own in zip(models, before, strict=True))
    return None if evidence is None and all(own is None for own in members) else EvidenceSet(members)


def in_attached_frame(observation: Observation, world_T_attached: Float[Tensor, "*b 4 4"]) -> Observation:
    """The observation with its world-fixed points carried to where they are in the attached frame now."""
    if len(observation) == 0 or (is_eager() and bool(observation.attached.all())):
        return observation
    carried = se3.apply(se3.inverse(world_T_attached), observation.points)
    return replace(observation, points=carried.where(~observation.attached[..., None], observation.points))


@container()
@dataclass(frozen=True)
class SemanticPoints:
    """Semantic points under RUMI's Boltzmann posterior, log L = -lambda C^(X, T) (Eq 10): an `Evidence`.

    Attributes:
        observation: the points, in the frame that rides with the object (`in_attached_frame`).
        discrepancy: C^.
        peakiness: lambda, nats per metre of discrepancy.
    """

    observation: Observation
    discrepancy: Discrepancy
    peakiness: float | Tensor = 2.0

    def cost(self, attached_T_object: Float[Tensor, "*b N 4 4"]) -> Float[Tensor, "*b N"]:
        """Discrepancy C^ of each pose, -log L / lambda."""
        return self.discrepancy(attached_T_object, self.observation)

    def log_likelihood(self, attached_T_object: Float[Tensor, "*b N 4 4"], /) -> Float[Tensor, "*b N"]:
        """-lambda C^ of each pose."""
        return -self.peakiness * self.cost(attached_T_object)
