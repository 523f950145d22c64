"""Guarded move: a motion that ends a little after its contact."""

import math
from collections.abc import Callable

from jaxtyping import Float
from torch import Tensor

from rumi.sim.world import LEVER_M


class GuardedMove:
    """Whether a motion is over: once the tool has gone on far enough while it felt something all along.

    Args:
        most_m: how far it goes on; a radian counts as its lever.
        felt: told of a mini step's number; where the tool is (Q), and whether it feels anything.
    """

    def __init__(self, most_m: float, felt: Callable[[int], tuple[Float[Tensor, "Q"], bool]]) -> None:
        self.most_m, self._felt = most_m, felt
        self._met: Float[Tensor, "Q"] | None = None

    def __call__(self, index: int) -> bool:
        """Whether the motion ends with this mini step."""
        here, felt = self._felt(index)
        if not felt:
            self._met = None
            return False
        if self._met is None:
            self._met = here
        gone = here - self._met
        turned = gone.new_tensor(math.remainder(float(gone[-1]), 2.0 * math.pi))  # a yaw may be told from -pi to pi
        return float(gone[:-1].norm() + LEVER_M * turned.abs()) >= self.most_m
