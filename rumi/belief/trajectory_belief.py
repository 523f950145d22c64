"""Belief of the trajectory filter: particles with how the object slides, and the history of actions and contacts."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.weights import effective_sample_size, resampled_weights
from sdf.batch import broadcast_shapes
from sdf.containers import container, index


class TouchAction(NamedTuple):
    """Action of the robot, with its contact signals.

    Attributes:
        path: (*b, K + 1, 3), (x, y, yaw) of the tool, where it began first.
        contact: (*b, K), the contact signal at the end of each part.
        blocked: whether the tool could not come down where the path begins, since the object stands there; None where
            that tells nothing, since it came from the side.
    """

    path: Float[Tensor, "*b K1 3"]
    contact: Bool[Tensor, "*b K"]
    blocked: bool | None = None

    def at(self, runs: Int[Tensor, "n"]) -> "TouchAction":
        """Those of some runs, or what all runs share."""
        own = self.path.ndim == 3 and len(self.path) > 1
        felt = self.contact.ndim == 2 and len(self.contact) > 1
        path, contact = self.path[runs] if own else self.path, self.contact[runs] if felt else self.contact
        return self._replace(path=path, contact=contact)


@container()
@dataclass(frozen=True, eq=False)
class TrajectoryBelief:
    """Weighted particles of R runs; each run has N.

    Attributes:
        start: (R, N, 3), (x, y, yaw) of the object before the first action.
        friction: (R, N), between tool and object.
        lever: (R, N), c of the limit surface, metres.
        noise: of each action so far, (R, N, 3) standard normal: what its motion differed by; empty without noise.
        pose: (R, N, 3), now.
        log_weights: (R, N), normalised.
        log_likelihood: (R, N), of all readings so far.
    """

    start: Float[Tensor, "R N 3"]
    friction: Float[Tensor, "R N"]
    lever: Float[Tensor, "R N"]
    noise: tuple[Tensor, ...]
    pose: Float[Tensor, "R N 3"]
    log_weights: Float[Tensor, "R N"]
    log_likelihood: Float[Tensor, "R N"]

    def ess(self) -> Float[Tensor, "R"]:
        """Effective sample size of each run."""
        return effective_sample_size(self.log_weights)

    def at(self, rows: Tensor) -> "TrajectoryBelief":
        """Some runs."""
        return index(self, rows)

    def put(self, rows: Tensor, other: "TrajectoryBelief") -> "TrajectoryBelief":
        """The same with some runs of another."""
        changes = {name: getattr(self, name).index_copy(0, rows, getattr(other, name)) for name in _PARTS}
        noise = tuple(a.index_copy(0, rows, b) for a, b in zip(self.noise, other.noise, strict=True))
        return replace(self, noise=noise, **changes)

    def resampled(self, index: Tensor) -> "TrajectoryBelief":
        """Particles (R, N) of each run, with equal weights, which keep their slope (`resampled_weights`)."""
        wide = index[..., None].expand(*index.shape, 3)
        return TrajectoryBelief(
            self.start.gather(1, wide),
            self.friction.gather(1, index),
            self.lever.gather(1, index),
            tuple(part.gather(1, wide) for part in self.noise),
            self.pose.gather(1, wide),
            resampled_weights(self.log_weights, index),
            self.log_likelihood.gather(1, index),
        )


_PARTS = ("start", "friction", "lever", "pose", "log_weights", "log_likelihood")


def concatenate(history: Sequence[TouchAction]) -> TouchAction:
    """Actions one after the other, as one; each begins where the one before ended, and none came from above."""
    first = history[0]
    paths = [first.path, *(action.path[..., 1:, :] for action in history[1:])]
    batch = broadcast_shapes(*(path.shape[:-2] for path in paths))
    path = torch.cat([part.expand(*batch, *part.shape[-2:]) for part in paths], -2)
    signals = [action.contact for action in history]
    batch = broadcast_shapes(*(signal.shape[:-1] for signal in signals))
    return TouchAction(path, torch.cat([part.expand(*batch, part.shape[-1]) for part in signals], -1))
