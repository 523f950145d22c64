"""What every push model is: control sequences in, predicted motion of robot and object out."""

from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.dynamics.sliding import rotated


class Paths(NamedTuple):
    """What the robot and the object do in some rollouts, after each of H actions.

    Attributes:
        configurations: (*b, H, Q), where the robot is.
        displacements: (*b, H, 3), how far the object, or its point at the `pivot`, has been moved, metres, world axes.
        turns: (*b, H), how far it has been turned, radians; None if never.
        pivot: (2,), where objects turn.
    """

    configurations: Float[Tensor, "*b H Q"]
    displacements: Float[Tensor, "*b H 3"]
    turns: Float[Tensor, "*b H"] | None = None
    pivot: Float[Tensor, "2"] | None = None

    def riding(self) -> tuple[Float[Tensor, "*b H Q"], Float[Tensor, "*b H 3"]]:
        """Configurations and displacements that meet of a field at rest what these meet of one riding on the object."""
        if self.turns is None or self.pivot is None:
            return self.configurations, self.displacements
        # the field turns with the object: look from where it has not moved
        cos, sin = self.turns.cos(), self.turns.sin()
        x, y = (self.configurations[..., :2] - self.pivot - self.displacements[..., :2]).unbind(-1)
        place = torch.stack((cos * x + sin * y, cos * y - sin * x), -1) + self.pivot
        height, yaw = self.configurations[..., 2:-1], self.configurations[..., -1] - self.turns
        seen = torch.cat((place, height, yaw[..., None]), -1)
        return seen, torch.zeros_like(self.displacements)

    def staying(self) -> tuple[Float[Tensor, "*b H Q"], Float[Tensor, "*b H 3"]]:
        """The same as if the object stayed."""
        return self.configurations, torch.zeros_like(self.displacements)


class PushRollouts(NamedTuple):
    """K control sequences of H steps, rolled out M times each; T = H + 1 instants, the present one first.

    Attributes:
        configurations: (K, M, T, Q), where the robot is.
        displacements: (K, M, T, 3), how far the object (with a `pivot`, its point that is there at present) has been
            moved since the present, metres, world axes.
        contact: (K, M, H), whether the robot touched the object during a step.
        checked: share of the contact checks that were done point by point; the rest was settled by a bound, or by
            another rollout that had met the same so far.
        twin: (K, M), the first rollout of the same sequence that is known to be the same throughout, itself if none is.
        turns: (K, M, T), how far the object has been turned since the present, radians; None if never.
        pivot: (2,), the point whose displacements are told, where objects turn.
    """

    configurations: Float[Tensor, "K M T Q"]
    displacements: Float[Tensor, "K M T 3"]
    contact: Bool[Tensor, "K M H"]
    checked: float
    twin: Int[Tensor, "K M"]
    turns: Float[Tensor, "K M T"] | None = None
    pivot: Float[Tensor, "2"] | None = None

    @property
    def touched(self) -> Bool[Tensor, "K M"]:
        """Whether a rollout touched the object at all; one that did not follows the free path."""
        return self.contact.any(-1)

    def paths(self, which: Bool[Tensor, "K M"]) -> Paths:
        """Some of the rollouts, (R, H, ...), after each action."""
        turns = None if self.turns is None else self.turns[:, :, 1:][which]
        return Paths(self.configurations[:, :, 1:][which], self.displacements[:, :, 1:][which], turns, self.pivot)


@runtime_checkable
class PushModel(Protocol):
    """Predicts how the robot moves and what it does to the object."""

    def rollout(
        self,
        configuration: Float[Tensor, "Q"],
        controls: Float[Tensor, "K H A"],
        *,
        rollouts: int,
        generator: torch.Generator,
    ) -> PushRollouts:
        """Roll control sequences out from one configuration.

        Args:
            configuration: where the robot is now.
            controls: in [-1, 1].
            rollouts: M, how often to draw each sequence.
            generator: all randomness.
        """
        ...

    def likely(self, configuration: Float[Tensor, "Q"], controls: Float[Tensor, "H A"]) -> PushRollouts:
        """The one rollout (K = M = 1) that is shown as the plan: what happens more likely than not."""
        ...


def rigid_motions(
    start: Float[Tensor, "E 3"], track: Float[Tensor, "E T 3"], pivot: Float[Tensor, "2"]
) -> tuple[Float[Tensor, "E T 3"], Float[Tensor, "E T"]]:
    """Displacement of a point that rides with each object, and turn, from a start pose (x, y, yaw) to later ones."""
    turn = track[..., 2] - start[:, None, 2]
    arm = (pivot - start[:, :2])[:, None].expand(-1, track.shape[1], 2)
    shift = track[..., :2] - start[:, None, :2] + rotated(arm, turn) - arm
    still = (track == start[:, None]).all(-1, keepdim=True)
    return torch.cat((torch.where(still, 0.0, shift), torch.zeros_like(shift[..., :1])), -1), turn


def representatives(yaw: Float[Tensor, "N"], weights: Float[Tensor, "N"], count: int) -> Int[Tensor, "count"]:
    """Indices of the yaws in the middles of `count` equal shares of the weight, counted from opposite their mean."""
    mean = torch.atan2(weights @ yaw.sin(), weights @ yaw.cos())
    turned = torch.remainder(yaw - mean + torch.pi, 2.0 * torch.pi)
    order = turned.sort(stable=True).indices
    below = weights[order].cumsum(0)
    middles = (torch.arange(count, dtype=below.dtype, device=below.device) + 0.5) / count
    return order[torch.searchsorted(below, middles * below[-1]).clamp_max(len(yaw) - 1)]


def twins(contact: Tensor) -> Int[Tensor, "K M"]:
    """The first rollout that touches nothing for those that touch nothing, else the rollout itself."""
    untouched = ~contact.any(-1)
    own = torch.arange(contact.shape[1], device=contact.device).expand(untouched.shape)
    return torch.where(untouched, untouched.to(torch.uint8).argmax(-1, keepdim=True), own)
