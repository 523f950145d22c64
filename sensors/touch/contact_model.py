"""Binary contact model: probability of a contact signal by the robot's distance from the object.

A reading says contact or none, for the robot as a whole. In the proximity model (touch-only paper, Eq 10) the chance
of a contact signal falls off with the distance of the robot's surface from the object, over all links; the binary model
has a step instead.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sdf.base import SDF
from sdf.check import check_shape
from sdf.numbers import Numbers, Range
from sdf.posed import posed_distance

_STEEPEST = 1e12
"""Of a decay, 1/m: a step, to any sensor."""


def proximity_probability(
    distance: Float[Tensor, "*b"],
    true_positive: float | Tensor = 0.5,
    false_positive: float | Tensor = 0.1,
    decay: float | Tensor = 1000.0,
) -> Float[Tensor, "*b"]:
    """P(contact signal) at a distance of robot and object: fp + (tp - fp) exp(-decay d) (Eq 10).

    As printed it exceeds 1 where the robot is inside of the object: the distance is clamped at 0.

    Args:
        distance: metres, of the robot's nearest surface point; below 0 inside.
        true_positive: probability at contact.
        false_positive: probability far away.
        decay: fall-off, 1/m.
    """
    return false_positive + (true_positive - false_positive) * torch.exp(-decay * _away(distance))


def _away(distance: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """At least 0, and finite: infinitely far away, a slope to the decay would be 0 times infinity."""
    return distance.clamp(0.0, torch.finfo(distance.dtype).max)


def touching_probability(
    distance: Float[Tensor, "*b"],
    true_positive: float | Tensor = 0.5,
    false_positive: float | Tensor = 0.1,
    tolerance: float | Tensor = 0.0,
) -> Float[Tensor, "*b"]:
    """P(contact signal) that knows touching and not touching only: tp within the tolerance (m), fp beyond."""
    near = (distance <= tolerance).to(distance.dtype)
    return false_positive + (true_positive - false_positive) * near


class ContactModel(Numbers):
    """P(contact signal | distance) of physical numbers, fixed or trained.

    Args:
        true_positive: probability of a signal at contact.
        false_positive: probability of a signal far away.
        decay: of the proximity model, 1/m; None for the binary model.
        tolerance: of the binary model, metres.
        trainable: train the rates, and of the proximity model the decay, within their range (`sdf.numbers.Numbers`);
            the binary model's step has no slope to its tolerance.
    """

    def __init__(
        self,
        true_positive: float = 0.5,
        false_positive: float = 0.1,
        decay: float | None = 1000.0,
        *,
        tolerance: float = 0.0,
        trainable: bool = False,
    ) -> None:
        super().__init__()
        for name, rate in (("true_positive", true_positive), ("false_positive", false_positive)):
            if not 0 <= rate <= 1:
                raise ValueError(f"Expected {name} to be a probability, got {rate}")
        # of more, its product with a distance of 0 may be no number
        if decay is not None and not 0 < decay < _STEEPEST:
            raise ValueError(
                f"Expected decay above 0 (to {_STEEPEST:g} 1/m), or None for the binary model, got {decay}"
            )
        self.smooth = decay is not None
        self.enter("true_positive", true_positive, Range.SHARE if trainable else None)
        self.enter("false_positive", false_positive, Range.SHARE if trainable else None)
        self.enter("decay", 0.0 if decay is None else decay, Range.POSITIVE if trainable else None)
        self.enter("tolerance", tolerance)
        self.true_positive: Tensor
        self.false_positive: Tensor
        self.decay: Tensor
        self.tolerance: Tensor

    def forward(self, distance: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """P(contact signal) at distances, metres."""
        tp, fp = self.true_positive.to(distance), self.false_positive.to(distance)
        if self.smooth:
            return proximity_probability(distance, tp, fp, self.decay.to(distance))
        return touching_probability(distance, tp, fp, self.tolerance.to(distance))

    def log_likelihood(
        self, distance: Float[Tensor, "*#b"], contact: Bool[Tensor, "*#b"], floor: float = 1e-12
    ) -> Float[Tensor, "*#b"]:
        """Log P(signal) where there was a contact signal, log (1 - P) where there was none; never below log floor."""
        probability = self(distance)
        return torch.where(contact, probability, self._silent(distance)).clamp_min(floor).log()

    def _silent(self, distance: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """1 - P(contact signal) (*b), not as a difference from 1, of which little is left where a signal is sure."""
        missed, gap = (1.0 - self.true_positive).to(distance), (self.true_positive - self.false_positive).to(distance)
        if not self.smooth:
            tolerance = self.tolerance.to(distance)
            return torch.where(distance <= tolerance, missed, (1.0 - self.false_positive).to(distance))
        return missed - gap * torch.expm1(-self.decay.to(distance) * _away(distance))


def robot_distance(
    sdf: SDF, world_T_object: Float[Tensor, "*b N 4 4"], points_w: Float[Tensor, "*b K M 3"]
) -> Float[Tensor, "*b N K"]:
    """Distance of a robot's surface points, all links together, from the object at every pose, at every instant.

    Args:
        sdf: of the object.
        world_T_object: (*b, N, 4, 4), poses of the object.
        points_w: (*b, K, M, 3), points on the robot's surface at each of K instants, world frame, metres.

    Returns:
        (*b, N, K), metres; infinite where there are no points.
    """
    check_shape("points_w", points_w, "(*b, K, M, 3)", last=(3,))
    instants, count = points_w.shape[-3:-1]
    poses = world_T_object.shape[-3]
    if instants * count == 0:
        return points_w.new_full((*world_T_object.shape[:-3], poses, instants), torch.inf)
    flat = points_w.reshape(*points_w.shape[:-3], instants * count, 3)
    distance = posed_distance(sdf, world_T_object, flat)
    return distance.reshape(*distance.shape[:-1], instants, count).amin(-1)
