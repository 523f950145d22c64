"""Object and tool as trajectories need them: how poses are, how they go on, and where points are from them."""

from typing import Protocol, runtime_checkable

from jaxtyping import Bool, Float
from torch import Tensor

from rumi.belief.systematic_errors import SystematicErrors
from rumi.belief.trajectory_history import History
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.dynamics.sliding import Sliding
from sdf.base import SDF


@runtime_checkable
class Pushed(Protocol):
    """Object and tool, as trajectories need them: `PushedObject` in the plane, `ToppledObject` in space.

    A pose is of D numbers, a tool's of T: (x, y, yaw) in the plane.
    """

    @property
    def sdf(self) -> SDF:
        """Signed distances of the object."""
        ...  # abstract: every member has one

    @property
    def resting_m(self) -> float:
        """Height of the object's origin from which the heights of points count."""
        ...

    @property
    def spread_m(self) -> float:
        """Mean distance of what rests on the floor from below the centre of mass; 1 where poses tell it."""
        ...

    @property
    def wide(self) -> float:
        """How much wider than the settings have it the noise of its motion is."""
        ...

    @property
    def pads(self) -> Float[Tensor, "m 3"]:
        """Points of the tool's pads, tool frame."""
        ...

    @property
    def replay(self) -> str:
        """Name of the versions that replay its trajectories."""
        ...

    @property
    def extent_m(self) -> tuple[float, float, float]:
        """How far its surface is from its place sideways, and how low and how high, at most."""
        ...

    @property
    def reach_m(self) -> float:
        """Distance from the tool's origin beyond which nothing is touched."""
        ...

    @property
    def reported(self) -> Float[Tensor, "m 3"]:
        """Where what the pads' points felt is reported, tool frame."""
        ...

    def world_T_object(self, poses: Float[Tensor, "*b D"]) -> Float[Tensor, "*b 4 4"]:
        """Poses in space, heights counted as those of points."""
        ...

    def local(self, pose: Float[Tensor, "N D"], points: Float[Tensor, "M 3"]) -> Float[Tensor, "N M 3"]:
        """Points in the frame of each pose."""
        ...

    def unsettled(self, poses: Float[Tensor, "N D"], least_rad: float = 0.0) -> Bool[Tensor, "N"]:
        """Whether each moves as soon as the tool does, touched or not: tilted by so much, it leans on the tool."""
        ...

    def lifted(self, tool_pose: Float[Tensor, "K 4 4"]) -> Bool[Tensor, "K"]:
        """Whether the tool is so high that it pushes nothing, where its path does not say so."""
        ...

    def middle(self, tool: Float[Tensor, "k T"]) -> Float[Tensor, "k 3"] | None:
        """Points on the axis of an upright, round tool at some of its poses, heights counted as those of points.

        None of another tool.
        """
        ...

    def path(self, tool_pose: Float[Tensor, "K 4 4"]) -> Float[Tensor, "K T"]:
        """What counts of the tool's poses, without jumps."""
        ...

    def tracks(
        self, own: PoseTrajectorySettings, some: Float[Tensor, "n D"], path: Float[Tensor, "K 2 T"]
    ) -> Float[Tensor, "n K D"]:
        """Where poses go by the median of the prior."""
        ...

    def step(
        self,
        own: PoseTrajectorySettings,
        pose: Float[Tensor, "N D"],
        before: Float[Tensor, "T"],
        after: Float[Tensor, "T"],
        body: Sliding,
        noise: Float[Tensor, "N 5"],
        errors: SystematicErrors | None = None,
    ) -> Float[Tensor, "N D"]:
        """Poses after an instant's push, and the noise of it.

        Args:
            own: of the motion prior.
            pose: before it.
            before: where the tool is taken to be then.
            after: the same after the instant.
            body: how each slides; its centre holds standard normals (x, y, ahead).
            noise: of the motion.
            errors: systematic ones; None for none.
        """
        ...

    def told_by_force(
        self,
        own: PoseTrajectorySettings,
        physics: Float[Tensor, "N P"],
        poses: Float[Tensor, "N S1 D"],
        history: History,
    ) -> Float[Tensor, "N S"]:
        """Log-likelihood of the tool's force in each segment, up to a constant."""
        ...
