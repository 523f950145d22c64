"""Plan proposal network: nominal plans from a summary of the belief, and the soft cost that it is trained by.

The cost has a gradient through the controls, the tool's path, the object that it pushes (`push_along_path`), and what
the pads meet; the planner's own cost marks cells, and has none.
"""

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
from rumi.tasks.rummage.agent import Rummager
from sdf import se3

SIDE = 40  # cells of an image to a side
CELLS = 80  # of the most information, by which the soft cost is worked out
CHANNELS = 2


@dataclass(frozen=True)
class Summary:
    """Summary of beliefs that a network sees.

    Attributes:
        image: (*b, 2, SIDE, SIDE), information and contact probability about the believed place.
        tool: (*b, 6), place of the tool from there, cosine and sine of its yaw, and the believed place.
    """

    image: Float[Tensor, "*b 2 S S"]
    tool: Float[Tensor, "*b 6"]

    @classmethod
    def of(
        cls, belief: PoseBelief, fields: WorkspaceFields, workspace: Workspace, configuration: Float[Tensor, "3"]
    ) -> Self:
        """Of one belief, by its fields on a planar workspace."""
        place = belief.weights @ belief.world_T_object[:, :2, 3]
        maps = torch.stack((fields.information / fields.information.max().clamp_min(1e-9), fields.contact))
        padded = functional.pad(maps.view(CHANNELS, *workspace.shape[:2]), [SIDE // 2] * 4)
        node = ((place - workspace.origin[:2]) / workspace.spacing).round().long()
        node = torch.minimum(node.clamp_min(0), node.new_tensor(workspace.shape[:2]))
        rows, columns = (slice(first, first + SIDE) for first in node.tolist())
        x, y, yaw = configuration[0] - place[0], configuration[1] - place[1], configuration[2]
        tool = torch.stack((4.0 * x, 4.0 * y, yaw.cos(), yaw.sin(), 4.0 * place[0] - 2.0, 4.0 * place[1]))
        return cls(padded[:, rows, columns].clone(), tool)


class ProposalNetwork(nn.Module):
    """Convolutional network from the summary of a belief to the knots of a few nominal plans.

    Args:
        planner: settings of the planner that the knots are for.
        proposals: nominal plans P.
        width: of the layers.
    """

    def __init__(self, planner: MPPISettings, *, proposals: int = 4, width: int = 24) -> None:
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
        )
        self.head = nn.Sequential(
            nn.Linear(2 * width * (SIDE // 8) ** 2 + 6, 256),
            nn.GELU(),
            nn.Linear(256, 128),
            nn.GELU(),
            nn.Linear(128, self.shape[0] * self.shape[1] * 3),
        )

    def forward(self, image: Float[Tensor, "B 2 S S"], tool: Float[Tensor, "B 6"]) -> Float[Tensor, "B P K 3"]:
        """Knots within the limits."""
        return self.head(torch.cat((self.body(image), tool), -1)).view(-1, *self.shape).tanh()

    @torch.no_grad()
    def propose(self, request: PlanRequest, fields: WorkspaceFields) -> Float[Tensor, "P K 3"]:
        """The `PlanProposals` of a policy."""
        scene = request.scene
        seen = Summary.of(request.belief, fields, scene.workspace, scene.configuration)
        return self(seen.image[None], seen.tool[None])[0]


@dataclass(frozen=True)
class Scenes:
    """Batch of scenes to train on.

    Attributes:
        seen: what the network sees.
        configuration: (B, 3), of the tool.
        poses: (B, N, 3), particles (x, y, yaw) of equal weight.
        cells: (B, C, 2), places of the most information, metres.
        worth: (B, C), their share of all information.
    """

    seen: Summary
    configuration: Float[Tensor, "B 3"]
    poses: Float[Tensor, "B N 3"]
    cells: Float[Tensor, "B C 2"]
    worth: Float[Tensor, "B C"]

    @classmethod
    def of(
        cls, beliefs: Sequence[PoseBelief], configurations: Sequence[Tensor], agent: Rummager, random: torch.Generator
    ) -> Self:
        """Of beliefs of one agent, each with its fields; particles are drawn by their weights."""
        seen, poses, cells, worth = [], [], [], []
        settings = policy_of(agent).settings.information
        for belief, configuration in zip(beliefs, configurations, strict=True):
            where = agent.workspace.points
            found = information_field(agent.model.sdf, belief.world_T_object, belief.log_weights, where, settings)
            seen.append(Summary.of(belief, found, agent.workspace, configuration))
            most = found.information.topk(CELLS)
            cells.append(where[most.indices, :2])
            worth.append(most.values / found.information.sum().clamp_min(1e-9))
            index = torch.multinomial(belief.weights, 64, replacement=True, generator=random)
            poses.append(se3.to_planar(belief.world_T_object[index]))
        summary = Summary(torch.stack([one.image for one in seen]), torch.stack([one.tool for one in seen]))
        return cls(
            summary, torch.stack(tuple(configurations)), torch.stack(poses), torch.stack(cells), torch.stack(worth)
        )

    def at(self, rows: Tensor) -> Self:
        """Some of the scenes."""
        seen = Summary(self.seen.image[rows], self.seen.tool[rows])
        return type(self)(seen, self.configuration[rows], self.poses[rows], self.cells[rows], self.worth[rows])


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
