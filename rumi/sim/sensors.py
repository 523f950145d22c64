"""Registry of the simulated sensors that measure numbers for evidence of their own."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.registry import Table
from rumi.sim.world import Track, World


@runtime_checkable
class SimulatedSensor(Protocol):
    """Measurement of a simulated sensor during an action."""

    def __call__(
        self, world: World, track: Track, world_T_tool: Float[Tensor, "K 4 4"], generator: torch.Generator, /
    ) -> Float[Tensor, "K ..."]:
        """Measured numbers at each of the action's K instants, NaN where the sensor gives none.

        Args:
            world: the scene, as it is after the action.
            track: where gripper and object were at each instant (`World.cast` takes these as `at`).
            world_T_tool: (K, 4, 4), the tool's pose at each instant.
            generator: of the noise.
        """
        ...


SIMULATED_SENSORS: Table[SimulatedSensor] = Table("simulated sensor", "rumi.simulated_sensors")
"""Simulated sensors by name, which is that of their measurements in a reading."""


def measure(
    names: Sequence[str], world: World, track: Track, world_T_tool: Float[Tensor, "K 4 4"], generator: torch.Generator
) -> dict[str, Float[Tensor, "K ..."]]:
    """Measurements of sensors by name, float32; see `SimulatedSensor`.

    Raises:
        UsageError: there is no such sensor; the message lists those that there are.
    """
    return {name: SIMULATED_SENSORS[name](world, track, world_T_tool, generator).float() for name in names}
