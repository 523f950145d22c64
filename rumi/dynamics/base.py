"""Push model: predicted motion of robot and object under controls, along a path, and in a filter."""

from collections.abc import Callable
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, Self, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.dynamics.along_path import PathPush
from rumi.dynamics.push_posterior import PushPosterior
from rumi.fields.information import WorkspaceFields
from rumi.fields.workspace import Workspace
from rumi.robot.tool import Tool
from rumi.robot.tool_shape import ToolShape
from sdf import gpu
from sdf.object_model import ObjectModel


class Paths(NamedTuple):
    """Paths of the robot and the object in some rollouts, after each of H actions.

    Attributes:
        configurations: (*b, H, Q), where the robot is.
        displacements: (*b, H, 3), how far the object, or its point at the `pivot`, has been moved, metres, world axes.
        turns: (*b, H), how far it has been turned, radians; None if never.
        pivot: (*#b, 2), where objects turn.
    """

    configurations: Float[Tensor, "*b H Q"]
    displacements: Float[Tensor, "*b H 3"]
    turns: Float[Tensor, "*b H"] | None = None
    pivot: Float[Tensor, "*#b 2"] | None = None

    def in_object_frame(self) -> tuple[Float[Tensor, "*b H Q"], Float[Tensor, "*b H 3"]]:
        """Configurations and displacements that meet of a field at rest what these meet of one riding on the object."""
        if self.turns is None or self.pivot is None:
            return self.configurations, self.displacements
        # the field turns with the object: look from where it has not moved
        cos, sin, pivot = self.turns.cos(), self.turns.sin(), self.pivot.unsqueeze(-2)
        x, y = (self.configurations[..., :2] - pivot - self.displacements[..., :2]).unbind(-1)
        place = torch.stack((cos * x + sin * y, cos * y - sin * x), -1) + pivot
        height, yaw = self.configurations[..., 2:-1], self.configurations[..., -1] - self.turns
        seen = torch.cat((place, height, yaw[..., None]), -1)
        return seen, torch.zeros_like(self.displacements)

    def object_fixed(self) -> tuple[Float[Tensor, "*b H Q"], Float[Tensor, "*b H 3"]]:
        """The same as if the object stayed."""
        return self.configurations, torch.zeros_like(self.displacements)


class PushRollouts(NamedTuple):
    """K control sequences of H steps, rolled out M times each; T = H + 1 instants, the present one first.

    With a batch of scenes all have its axes in front.

    Attributes:
        configurations: (*b, K, M, T, Q), where the robot is.
        displacements: (*b, K, M, T, 3), how far the object (with a `pivot`, its point that is there at present) has
            been moved since the present, metres, world axes.
        contact: (*b, K, M, H), whether the robot touched the object during a step.
        checked: share of the contact checks that were done point by point; the rest was settled by a bound, or by
            another rollout that had met the same so far. A tensor where it was counted on a GPU.
        duplicate_of: (*b, K, M), the first rollout of the same sequence that is known to be equal; itself if none is.
        turns: (*b, K, M, T), how far the object has been turned since the present, radians; None if never.
        pivot: (*b, 2), the point whose displacements are told, where objects turn.
    """

    configurations: Float[Tensor, "*b K M T Q"]
    displacements: Float[Tensor, "*b K M T 3"]
    contact: Bool[Tensor, "*b K M H"]
    checked: float | Float[Tensor, ""]
    duplicate_of: Int[Tensor, "*b K M"]
    turns: Float[Tensor, "*b K M T"] | None = None
    pivot: Float[Tensor, "*b 2"] | None = None

    @property
    def touched(self) -> Bool[Tensor, "*b K M"]:
        """Whether a rollout touched the object at all; one that did not follows the free path."""
        return self.contact.any(-1)

    def paths(self, which: Bool[Tensor, "*b K M"]) -> Paths:
        """Some of the rollouts, (R, H, ...), after each action."""
        rows, axes = which.flatten().nonzero()[:, 0], which.ndim - 1  # looked for once, for all of them
        pivot, turns = self.pivot, None if self.turns is None else self.turns[..., 1:].flatten(0, axes)[rows]
        configurations, displacements = (
            part[..., 1:, :].flatten(0, axes)[rows] for part in (self.configurations, self.displacements)
        )
        if pivot is not None and pivot.ndim > 1:
            pivot = pivot[..., None, None, :].expand(*which.shape, 2).flatten(0, axes)[rows]
        return Paths(configurations, displacements, turns, pivot)

    @property
    def first(self) -> Paths:
        """The first rollout of the first sequence of one scene, (H, ...), after each action."""
        turns = None if self.turns is None else self.turns[0, 0, 1:]
        return Paths(self.configurations[0, 0, 1:], self.displacements[0, 0, 1:], turns, self.pivot)


@runtime_checkable
class RolloutModel(Protocol):
    """A push model under one belief: predicts how the robot moves and what it does to the object."""

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
            generator: of the random draws.
        """
        ...

    def nominal_rollout(self, configuration: Float[Tensor, "Q"], controls: Float[Tensor, "H A"]) -> PushRollouts:
        """The one rollout (K = M = 1) that is shown as the plan: what happens more likely than not."""
        ...

    def coarse(self) -> Self:
        """A model of the same that is quicker, to tell which samples are worth rolling out; itself if there is none."""
        ...


class PushDefaults(NamedTuple):
    """Settings of the planner that were found best for a push model.

    Attributes:
        reachability_scale: weight of the reachability cost (beta_R).
        rollouts: of each control sequence.
        least_share: of the information, what a plan has to gather not to be made anew with less weight on reach.
    """

    reachability_scale: float
    rollouts: int
    least_share: float = 0.0


# metres off upright or off a height at which a particle's outline is another
LEVEL_M = 1e-3

Use = Literal["rollouts", "path", "motion"]
"""What a push model is asked for, by the name of its method."""

ObjectMotion = Callable[[Float[Tensor, "E 3"], Float[Tensor, "E K 3"]], Float[Tensor, "E K 4 4"]]
"""World motion of objects at poses (x, y, yaw), up to each instant of a tool's path (x, y, yaw)."""


class PushModel:
    """A model of pushing with up to three uses; a member of `rumi.dynamics.registry.PUSH_MODELS`.

    A member overrides `make` and the uses that it has. A run that needs another use is refused when it is built.

    Attributes:
        defaults: of the planner.
        objects: what it can push: "any" object, an "upright" one, or an upright one with a level tool ("planar").
    """

    defaults: ClassVar[PushDefaults]
    objects: ClassVar[Literal["any", "upright", "planar"]] = "any"

    @classmethod
    def make(cls, settings: Any) -> Self:  # noqa: ANN401  (PushSettings, which know all members)
        """The model that `rumi.dynamics.registry.PushSettings` describe."""
        raise NotImplementedError

    @classmethod
    def has(cls, use: Use) -> bool:
        """Whether it has a use."""
        return getattr(cls, use) is not getattr(PushModel, use)

    def fits(self, world_T_object: Float[Tensor, "N 4 4"], tool: Tool) -> bool:
        """Whether it can push particles at these poses with this tool."""
        return True

    def takes_scenes(self, world_T_object: Float[Tensor, "B N 4 4"]) -> bool:
        """Whether `rollouts` takes the particles of these scenes in one call, each row as alone."""
        return False

    def knowing(self, pushes: PushPosterior) -> Self:
        """The same model by what was learnt of how the object slides; itself, where that plays no part."""
        return self

    def rollouts(
        self,
        model: ObjectModel,
        world_T_object: Float[Tensor, "N 4 4"],
        log_weights: Float[Tensor, "N"],
        tool: Tool,
        workspace: Workspace,
        fields: WorkspaceFields,
    ) -> RolloutModel:
        """Rollouts of control sequences under one belief, for the planner.

        Args:
            model: the object.
            world_T_object: particles.
            log_weights: of them.
            tool: points and free-space motion.
            workspace: the lattice of the fields.
            fields: of the belief.

        Raises:
            ValueError: the particles cannot be pushed.
        """
        raise NotImplementedError

    def path(self, scene: Callable[[], Any] | None = None) -> PathPush:
        """Pushes of given objects along given tool paths, for the filter over trajectories.

        Args:
            scene: makes the scene of a simulator (`rumi.sim.path_push.PathScene`), for a model that is one.
        """
        raise NotImplementedError

    def motion(self, model: ObjectModel, shape: ToolShape, height_m: float, resting_m: float) -> ObjectMotion:
        """Motion of an upright object along the path that a level tool reports, for the filter over poses.

        Args:
            model: the object.
            shape: of the tool.
            height_m: of the tool above the floor.
            resting_m: of the object's origin above the floor.
        """
        raise NotImplementedError


def rigid_motions(
    start: Float[Tensor, "E 3"],
    track: Float[Tensor, "E T 3"],
    pivot: Float[Tensor, "*#E 2"],
) -> tuple[Float[Tensor, "E T 3"], Float[Tensor, "E T"]]:
    """Displacement of a point that rides with each object, and turn, from a start pose (x, y, yaw) to later ones.

    Skipped, with the same result: objects that never move.

    Args:
        start: poses.
        track: poses at T instants.
        pivot: the point at the start, of all objects or of each.
    """
    shift, turn = track.new_zeros(track.shape), track.new_zeros(track.shape[:-1])
    rows = (track != start[:, None]).flatten(1).any(-1).nonzero()[:, 0]
    about = pivot.expand(len(start), 2)[rows][:, None]
    start, track = start[rows][:, None], track[rows]
    x, y, yaw = start.unbind(-1)
    arm_x, arm_y = about[..., 0] - x, about[..., 1] - y
    turned = track[..., 2] - yaw
    cos, sin = turned.cos(), turned.sin()
    way_x = track[..., 0] - x + (cos * arm_x - sin * arm_y) - arm_x
    way_y = track[..., 1] - y + (sin * arm_x + cos * arm_y) - arm_y
    moved = (track != start).any(-1)
    shift[rows, :, :2] = torch.where(moved[..., None], torch.stack((way_x, way_y), -1), 0.0)
    turn[rows] = turned
    return shift, turn


def shares_by_yaw(yaw: Float[Tensor, "N"], weights: Float[Tensor, "N"]) -> tuple[Int[Tensor, "N"], Float[Tensor, "N"]]:
    """Particles in the order of their yaws, counted from opposite their mean, and the weight up to each of them."""
    mean = torch.atan2(weights @ yaw.sin(), weights @ yaw.cos())
    turned = torch.remainder(yaw - mean + torch.pi, 2.0 * torch.pi)
    order = turned.sort(stable=True).indices
    return order, weights[order].cumsum(0)


def middles_of_shares(below: Float[Tensor, "N"], count: int) -> Int[Tensor, "count"]:
    """Places in the middles of `count` equal shares of a weight that adds up to `below`."""
    middles = gpu.constant(tuple((index + 0.5) / count for index in range(count)), below.dtype, below.device)
    return torch.searchsorted(below, middles * below[-1]).clamp_max(len(below) - 1)


def representatives(yaw: Float[Tensor, "N"], weights: Float[Tensor, "N"], count: int) -> Int[Tensor, "count"]:
    """Indices of the yaws in the middles of `count` equal shares of the weight, counted from opposite their mean."""
    order, below = shares_by_yaw(yaw, weights)
    return order[middles_of_shares(below, count)]


def duplicates(contact: Tensor) -> Int[Tensor, "*b K M"]:
    """The first rollout that touches nothing for those that touch nothing, else the rollout itself."""
    untouched = ~contact.any(-1)
    own = torch.arange(contact.shape[-2], device=contact.device).expand(untouched.shape)
    return torch.where(untouched, untouched.to(torch.uint8).argmax(-1, keepdim=True), own)


class Stance(NamedTuple):
    """How particles stand.

    Attributes:
        least_up: least cosine between a particle's z axis and the world's.
        spread_m: of the heights of their origins.
        height_m: of their origins, in the mean.
    """

    least_up: float
    spread_m: float
    height_m: float

    @classmethod
    def of(cls, world_T_object: Float[Tensor, "*b N 4 4"]) -> "Stance":
        """Of particles, by one copy from a GPU."""
        heights = world_T_object[..., 2, 3]
        numbers = (world_T_object[..., 2, 2].min(), heights.max() - heights.min(), heights.mean())
        return cls(*torch.stack(numbers).tolist())

    @property
    def rests(self) -> bool:
        """Whether particles are upright and at one height, so that one outline is that of all."""
        return not self.least_up < 1.0 - LEVEL_M and self.spread_m <= LEVEL_M

    def checked(self) -> Self:
        """Itself.

        Raises:
            ValueError: particles are not upright, or at different heights.
        """
        if not self.rests:
            raise ValueError(
                "Expected upright particles at one height to push one by one, got others: choose the push model "
                "'displacement'"
            )
        return self
