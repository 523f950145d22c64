"""Plan proposal network: nominal plans from a summary of the belief, and the soft cost that it is trained by.

The cost has a gradient through the controls, the tool's path, the object that it pushes (`push_along_path`), and what
the pads meet; the planner's own cost marks cells, and has none.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from kmppi import MPPI, MPPISettings
from rumi.belief.particles import PoseBelief
from rumi.dynamics.along_path import PathMotion, push_along_path
from rumi.dynamics.outline import GridOutline
from rumi.dynamics.sliding import rotated
from rumi.fields.information import WorkspaceFields, information_field
from rumi.fields.workspace import Workspace
from rumi.planning.policy import PlanRequest
from rumi.planning.rummaging import RummagingPolicy
from rumi.robot.tool import Tool
from rumi.tasks.rummage.agent import Rummager
from sdf import se3

SIDE = 41  # nodes of an image to a side, a centimetre apart
HALF_M = 0.2  # from its middle to its border
CELLS = 80  # of the most information, by which the soft cost is worked out
POSES = 16  # of the object, that scenes to train on keep
CHANNELS = 2
NUMBERS = 6


@dataclass(frozen=True)
class Frame:
    """Frame that a scene's plans are told in: x leads from the arm's base past the object, y is mirrored.

    The arm reaches as far in one direction as in the next, and gripper and mug have a plane of symmetry, so that scenes
    turned about the base or mirrored have the same plans here, and one of them is learnt from.

    Attributes:
        angle: (*b,), of x from the world's, radians.
        mirror: (*b,), 1, or -1 where y is the other way round: the tool is never on the side of y > 0.
    """

    angle: Float[Tensor, "*b"]
    mirror: Float[Tensor, "*b"]

    @classmethod
    def of(cls, base: Float[Tensor, "3"], place: Float[Tensor, "2"], configuration: Float[Tensor, "3"]) -> Self:
        """For an arm's base, where the object is believed to be, and the tool."""
        x, y = (place - base[:2]).unbind(-1)
        side = x * (configuration[1] - place[1]) - y * (configuration[0] - place[0])
        return cls(torch.atan2(y, x), torch.where(side > 0, -1.0, 1.0))

    def to_world(self, inner: Float[Tensor, "*b n 2or3"]) -> Float[Tensor, "*b n 2or3"]:
        """Vectors (x, y), or motions (x, y, yaw), by world axes."""
        cos, sin, mirror = (of.unsqueeze(-1) for of in (self.angle.cos(), self.angle.sin(), self.mirror))
        x, y = inner[..., 0], mirror * inner[..., 1]
        rest = mirror[..., None] * inner[..., 2:]
        return torch.cat((torch.stack((cos * x - sin * y, sin * x + cos * y), -1), rest), -1)

    def at(self, rows: Tensor) -> Self:
        """Of some scenes."""
        return type(self)(self.angle[rows], self.mirror[rows])


@dataclass(frozen=True)
class Summary:
    """Summary of beliefs that a network sees.

    Attributes:
        image: (*b, 2, SIDE, SIDE), information and contact probability about the believed place.
        frame: that image and tool are told in.
        tool: (*b, 6), the tool's place from there, cosine and sine of its yaw, and how far it and the base are.
    """

    image: Float[Tensor, "*b 2 S S"]
    frame: Frame
    tool: Float[Tensor, "*b 6"]

    @classmethod
    def of(
        cls,
        belief: PoseBelief,
        fields: WorkspaceFields,
        workspace: Workspace,
        tool: Tool,
        configuration: Float[Tensor, "3"],
    ) -> Self:
        """Of one belief, by its fields on a planar workspace."""
        assert tool.reach is not None
        place, base = belief.weights @ belief.world_T_object[:, :2, 3], tool.reach.base[:2]
        frame = Frame.of(tool.reach.base, place, configuration)
        axis = torch.linspace(-HALF_M, HALF_M, SIDE)
        nodes = place + frame.to_world(torch.cartesian_prod(axis, axis))
        last = nodes.new_tensor([n - 1.0 for n in workspace.shape[:2]])
        at = 2.0 * (nodes - workspace.origin[:2]) / (workspace.spacing * last) - 1.0
        maps = torch.stack((fields.information / fields.information.max().clamp_min(1e-9), fields.contact))
        maps = maps.view(1, CHANNELS, *workspace.shape[:2])
        image = functional.grid_sample(maps, at.flip(-1).view(1, SIDE, SIDE, 2), align_corners=True)[0]
        away, yaw = configuration[:2] - place, configuration[2] - frame.angle
        along, across = torch.stack((frame.angle.cos(), frame.angle.sin())), frame.mirror
        beside = across * (along[0] * away[1] - along[1] * away[0])
        far, reached = away.norm(), (place - base).norm()
        numbers = (4.0 * along @ away, 4.0 * beside, yaw.cos(), across * yaw.sin(), 4.0 * far, 4.0 * reached - 4.0)
        return cls(image, frame, torch.stack(numbers))

    def at(self, rows: Tensor) -> Self:
        """Of some scenes."""
        return type(self)(self.image[rows], self.frame.at(rows), self.tool[rows])


class ProposalNetwork(nn.Module):
    """Convolutional network from the summary of a belief to the knots of a set of nominal plans.

    Args:
        planner: settings of the planner that the knots are for.
        proposals: nominal plans P.
        width: channels of the first layer.
        hidden: units of the layers after those.
    """

    def __init__(self, planner: MPPISettings, *, proposals: int = 32, width: int = 24, hidden: int = 384) -> None:
        super().__init__()
        self.planner = MPPI(planner, 3)
        self.shape = (proposals, self.planner.parameterization.knots, 3)
        self.body = nn.Sequential(
            nn.Conv2d(CHANNELS, width, 5, 2, 2),
            nn.GELU(),
            nn.Conv2d(width, 2 * width, 5, 2, 2),
            nn.GELU(),
            nn.Conv2d(2 * width, 2 * width, 3, 2, 1),
            nn.GELU(),
            nn.Flatten(),
            nn.LazyLinear(hidden),
        )
        self.tool = nn.Sequential(nn.Linear(NUMBERS, 128), nn.GELU(), nn.Linear(128, hidden))
        self.head = nn.Sequential(
            nn.GELU(),
            nn.Linear(hidden, hidden),
            nn.GELU(),
            nn.Dropout(0.1),
            nn.Linear(hidden, self.shape[0] * self.shape[1] * 3),
        )
        self(torch.zeros(1, CHANNELS, SIDE, SIDE), torch.zeros(1, NUMBERS))  # the lazy layer takes its size

    def forward(self, image: Float[Tensor, "B 2 S S"], tool: Float[Tensor, "B 6"]) -> Float[Tensor, "B P K 3"]:
        """Knots by the axes of the scenes' frames."""
        # limits are the world's, so that turned controls may be longer
        return math.sqrt(2.0) * self.head(self.body(image) + self.tool(tool)).view(-1, *self.shape).tanh()

    def plans(self, seen: Summary) -> Float[Tensor, "B P K 3"]:
        """Knots of nominal plans for a batch of scenes, within the limits."""
        knots = self(seen.image, seen.tool)
        return seen.frame.to_world(knots.flatten(1, 2)).view_as(knots).clamp(-1.0, 1.0)

    @torch.no_grad()
    def propose(self, request: PlanRequest, fields: WorkspaceFields) -> Float[Tensor, "P K 3"]:
        """The `PlanProposals` of a policy."""
        scene = request.scene
        seen = Summary.of(request.belief, fields, scene.workspace, scene.tool, scene.configuration)
        frame = Frame(seen.frame.angle[None], seen.frame.mirror[None])
        return self.plans(Summary(seen.image[None], frame, seen.tool[None]))[0]


@dataclass(frozen=True)
class Scenes:
    """Batch of scenes to train on.

    Attributes:
        seen: what the network sees.
        configuration: (B, 3), of the tool.
        poses: (B, N, 3), particles (x, y, yaw) of equal weight.
        cells: (B, C, 2), places of the most information, metres.
        worth: (B, C), their share of all information.
        knots: (B, T, K, 3), of good plans.
        costs: (B, T), of those.
    """

    seen: Summary
    configuration: Float[Tensor, "B 3"]
    poses: Float[Tensor, "B N 3"]
    cells: Float[Tensor, "B C 2"]
    worth: Float[Tensor, "B C"]
    knots: Float[Tensor, "B T K 3"]
    costs: Float[Tensor, "B T"]

    @classmethod
    def of(
        cls,
        agent: Rummager,
        belief: PoseBelief,
        configuration: Float[Tensor, "3"],
        knots: Float[Tensor, "T K 3"],
        costs: Float[Tensor, "T"],
        random: torch.Generator,
    ) -> Self:
        """Of one belief of an agent (B = 1), with its fields; particles are drawn by their weights."""
        where, settings = agent.workspace.points, policy_of(agent).settings.information
        found = information_field(agent.model.sdf, belief.world_T_object, belief.log_weights, where, settings)
        most = found.information.topk(CELLS)
        index = torch.multinomial(belief.weights, POSES, replacement=True, generator=random)
        one = cls(
            Summary.of(belief, found, agent.workspace, agent.tool, configuration),
            configuration,
            se3.to_planar(belief.world_T_object[index]),
            where[most.indices, :2],
            most.values / found.information.sum().clamp_min(1e-9),
            knots,
            costs,
        )
        return cls.from_parts([part[None] for part in one.parts])

    @property
    def parts(self) -> tuple[Tensor, ...]:
        """All tensors, to be kept."""
        seen, frame = self.seen, self.seen.frame
        own = (self.configuration, self.poses, self.cells, self.worth, self.knots, self.costs)
        return (seen.image, frame.angle, frame.mirror, seen.tool, *own)

    @classmethod
    def from_parts(cls, parts: Sequence[Tensor]) -> Self:
        """Of `parts`."""
        image, angle, mirror, tool, *own = parts
        return cls(Summary(image, Frame(angle, mirror), tool), *own)

    def at(self, rows: Tensor) -> Self:
        """Some of the scenes."""
        return self.from_parts([part[rows] for part in self.parts])


def policy_of(agent: Rummager) -> RummagingPolicy:
    """The agent's policy, one that plans.

    Raises:
        TypeError: it does not.
    """
    if not isinstance(agent.policy, RummagingPolicy):
        raise TypeError(f"Expected an agent whose policy plans by KMPPI, got {type(agent.policy).__name__}")
    return agent.policy


class SoftCost:
    """Differentiable cost of controls for a batch of scenes: information met by the pads, and reach.

    A cell is met at a step by exp(-(d / w)^2 / 2), d being its distance from the pads, so that the cost tends to the
    planner's as the width w tends to half a cell. The information rides with each pose that is pushed.

    Args:
        agent: whose object, tool, reach and costs they are.
        substeps: of an action.
    """

    def __init__(self, agent: Rummager, *, substeps: int = 3) -> None:
        policy = policy_of(agent)
        own = policy.settings.quasi_static
        self.tool, self.discount, self.substeps = agent.tool, policy.settings.information_discount, substeps
        self.pushed = PathMotion.of(
            agent.model.sdf,
            agent.tool.height_m - agent.height_m,
            agent.tool.shape,
            push_along_path,
            spacing_m=own.spacing_m,
            lever_ratio=own.lever_ratio,
            friction=own.friction,
        )
        self.pads = _distance_table(agent.tool.info[:, :2])
        self.scale = policy.settings.suited("quasi-static").reachability_scale
        assert policy.reachability is not None
        self.workspace = agent.workspace
        self.reach = policy.reachability.view(1, 1, *agent.workspace.shape[:2])

    def __call__(
        self, controls: Float[Tensor, "B P H 3"], scenes: Scenes, poses: Float[Tensor, "B M 3"], width: float
    ) -> Float[Tensor, "B P"]:
        """Cost of each plan, the mean over some poses that the object may have.

        Args:
            controls: of the plans.
            scenes: that they are for.
            poses: of the object, world.
            width: w, metres.
        """
        batch, plans, horizon, _ = controls.shape
        shape = (batch, plans, poses.shape[1])
        start = scenes.configuration[:, None, None]
        path = torch.cat((start.expand(-1, plans, 1, 3), self.tool.free_path(start[:, 0], controls, 1)), 2)
        path = path[:, :, None].expand(*shape, horizon + 1, 3).reshape(-1, horizon + 1, 3)
        first = poses[:, None].expand(*shape, 3).reshape(-1, 3)
        own = self.pushed
        track = push_along_path(
            first, path, own.pusher, own.outline, own.sliding, substeps=self.substeps, passes=1, distances=False
        ).track
        turn = track[..., 2] - first[:, None, 2]  # (R, H)
        cells = scenes.cells[:, None, None].expand(*shape, -1, 2).flatten(0, 2)
        cells = track[:, :, None, :2] + rotated((cells - first[:, None, :2])[:, None], turn[..., None])  # (R, H, C, 2)
        worth = scenes.worth[:, None, None].expand(*shape, -1).flatten(0, 2)
        tool = path[:, 1:, None]
        gap = self.pads(rotated(cells - tool[..., :2], -tool[..., 2])).distance.clamp_min(0.0)
        met = torch.exp(-0.5 * (gap / width) ** 2)
        missed = torch.log1p(-0.999 * met)
        before = missed.cumsum(1) - missed
        later = self.discount ** torch.arange(horizon, dtype=met.dtype)
        gathered = ((met * before.exp()) * later[:, None]).sum(1)
        share = (self._reach_at(cells) * worth[:, None]).sum(-1).mean(-1) / worth.sum(-1).clamp_min(1e-9)
        return (-(gathered * worth).sum(-1) - self.scale * share).view(shape).mean(-1)

    def _reach_at(self, places: Float[Tensor, "R H C 2"]) -> Float[Tensor, "R H C"]:
        last = places.new_tensor([n - 1.0 for n in self.workspace.shape[:2]])
        at = 2.0 * (places - self.workspace.origin[:2]) / (self.workspace.spacing * last) - 1.0
        found = functional.grid_sample(self.reach, at.flip(-1).reshape(1, -1, 1, 2), align_corners=True)
        return found.view(places.shape[:-1])


def _distance_table(points: Float[Tensor, "m 2"], *, spacing: float = 0.004, margin: float = 0.25) -> GridOutline:
    """Distance from the nearest of some points, less half of what a cell of the planner reaches."""
    low, high = points.amin(0) - margin, points.amax(0) + margin
    axes = [torch.arange(float(low[i]), float(high[i]), spacing) for i in range(2)]
    nodes = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    values = torch.cdist(nodes.flatten(0, 1), points).amin(-1).view(nodes.shape[:2]) - 0.004
    return GridOutline(values, low, spacing, float(points.norm(dim=-1).max()))
