"""Build of a simulated object that is not quite the one that is looked for, drawn by seed."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.seeding import split
from rumi.sim.error_settings import BuildSpread
from rumi.sim.reshaped import resized, worn
from rumi.sim.settings import PhysicsSettings
from sdf.base import SDF
from sdf.mesh.mesh_sdf import MeshSDF


@dataclass(frozen=True)
class Build:
    """How one object differs from its model.

    Attributes:
        mass: factor of its mass.
        friction: factor of the friction of everything.
        com_m: (3,), by which its centre of mass lies off, its own frame.
        scale: factor of its size.
        worn_m: how much deeper its surface lies than of that size.
    """

    mass: float
    friction: float
    com_m: Float[Tensor, "3"]
    scale: float
    worn_m: float

    @classmethod
    def drawn(cls, spread: BuildSpread, seed: int) -> "Build":
        """The object of a seed: factors evenly about 1, the centre of mass evenly in a ball, wear evenly from 0."""
        generator = split(seed, "build")
        mass, friction, scale = (2.0 * torch.rand(3, generator=generator, dtype=torch.float64) - 1.0).tolist()
        way = torch.nn.functional.normalize(torch.randn(3, generator=generator, dtype=torch.float64), dim=0)
        far, wear = torch.rand(2, generator=generator, dtype=torch.float64).tolist()
        return cls(
            1.0 + spread.mass * mass,
            1.0 + spread.friction * friction,
            spread.com_m * far ** (1.0 / 3.0) * way,
            1.0 + spread.scale * scale,
            spread.worn_m * wear,
        )

    @classmethod
    def thinnest(cls, spread: BuildSpread) -> "Build":
        """The smallest and most worn one, which a model has to bear."""
        return cls(1.0, 1.0, torch.zeros(3, dtype=torch.float64), 1.0 - spread.scale, spread.worn_m)

    def physics(self, physics: PhysicsSettings) -> PhysicsSettings:
        """The physics of the object."""
        x, y, z = self.com_m.tolist()
        return replace(
            physics, mass_kg=self.mass * physics.mass_kg, friction=self.friction * physics.friction, com_m=(x, y, z)
        )

    def shape(self, shape: SDF) -> SDF:
        """The shape of the object; a mesh is as it was given.

        Raises:
            UsageError: the shape is of a kind that has no other size, or does not bear the wear.
        """
        if isinstance(shape, MeshSDF):  # its convex pieces would have to be worked out for every seed, a minute each
            return shape
        try:
            other = resized(shape, self.scale) if self.scale != 1.0 else shape
            return worn(other, self.worn_m) if self.worn_m > 0 else other
        except UsageError:
            raise
        except ValueError as error:
            raise UsageError(
                f"Expected an object that bears {1e3 * self.worn_m:.1f} mm of wear: {error}; "
                "--simulator.build.worn-m 0 wears none"
            ) from error
