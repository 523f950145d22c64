"""The pose filter of a batch whose scenes hold different objects."""

from collections.abc import Sequence

import torch
from jaxtyping import Int
from torch import Tensor, nn

from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterInfo, PoseFilter
from rumi.seeding import Generators
from sdf.containers import index, join
from sensors.observation import Observation
from sensors.reading import Reading


class MixedFilter(nn.Module):
    """Filters of several objects as one; each scene of a batch is of one of the objects.

    Scenes of an object are taken together, so that a row is what that object's filter gives of the scene alone.

    Args:
        filters: of the objects.

    Raises:
        ValueError: there are none.
    """

    def __init__(self, filters: Sequence[PoseFilter]) -> None:
        super().__init__()
        if not filters:
            raise ValueError("Expected the filter of one object or more, got none")
        self.filters = nn.ModuleList(filters)

    def forward(
        self,
        belief: PoseBelief,
        memory: Observation,
        reading: Reading,
        of: Int[Tensor, "b"],
        *,
        generator: Sequence[torch.Generator],
    ) -> tuple[PoseBelief, Observation, FilterInfo]:
        """One filter step of each scene; arguments and result as of `PoseFilter`, with one batch axis.

        Args:
            belief: before the reading.
            memory: all points so far.
            reading: what the action's sensors reported.
            of: (b), the number of each scene's object.
            generator: one a scene.

        Raises:
            ValueError: the numbers are not of objects, or not as many as scenes.
        """
        count = len(belief.log_weights)
        if of.shape != (count,) or len(generator) != count or bool(((of < 0) | (of >= len(self.filters))).any()):
            raise ValueError(
                f"Expected an object's number, 0 to {len(self.filters) - 1}, and a generator for each of {count} "
                f"scenes, got {of.tolist()} and {len(generator)}"
            )
        parts, order = [], []
        for number in of.unique().tolist():
            rows = (of == number).nonzero()[:, 0]
            own: Generators = [generator[row] for row in rows.tolist()]
            given = (index(part, rows) for part in (belief, memory, reading))
            parts.append(self.filters[number](*given, generator=own))
            order.append(rows)
        found: tuple[PoseBelief, Observation, FilterInfo] = index(join(parts), torch.cat(order).argsort())
        return found
