"""The straightforward ways to do some of the work, as one writes them down from the paper: nothing is skipped."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.contact import ContactField
from rumi.dynamics.displacement_rollouts import TIE, DisplacementSettings
from rumi.dynamics.tool_lookup import ToolField, placement, planar_features, world_height
from rumi.robot.tool import Tool
from sdf.voxel_grid import VoxelGrid


def roll_out(
    field: ContactField,
    tool: Tool,
    settings: DisplacementSettings,
    configuration: Float[Tensor, "3"],
    controls: Float[Tensor, "K H A"],
    uniforms: Float[Tensor, "K M H S"],
) -> tuple[Float[Tensor, "R H1 3"], Float[Tensor, "R H1 3"]]:
    """RUMI's Alg 7, corrected (`displacement_rollouts`): every point of every rollout at every mini step.

    Looked up by the library's image sampler, the quickest that plain torch has.

    Returns:
        configurations and displacements (R = K M) at the present and after each action.
    """
    (samples, horizon, _), rollouts, mini = controls.shape, uniforms.shape[1], settings.mini_steps
    count = samples * rollouts
    draws = uniforms.expand(samples, rollouts, horizon, mini).reshape(count, horizon, mini)
    controls = controls.repeat_interleave(rollouts, 0)
    points = world_height(tool.body, tool.height_m).to(field.probability.values)
    probability, normal = ToolField(field.probability, points), ToolField(field.normal, points)
    q, moved = configuration.expand(count, 3), controls.new_zeros(count, 3)
    states, displacements = [q], [moved]
    for action in range(horizon):
        way = (tool.free_step(q, controls[:, action])[0] - q) / mini
        for part in range(mini):
            ahead = q + way
            features = planar_features(ahead, moved)
            likely = probability(features)[0]
            most = likely.amax(-1)
            touches = draws[:, action, part] < most
            point = (likely >= most[:, None] - TIE).to(torch.uint8).argmax(-1)
            motion = _place(points[point], ahead) - _place(points[point], q)
            facing = normal.at(features, point).mT
            length, far = facing.norm(dim=-1), motion.norm(dim=-1)
            inward = -(facing * motion).sum(-1) > math.cos(settings.push_angle) * length * far
            pushes = touches & inward & (length > 1e-6) & (far > 1e-6)
            moved = torch.where(pushes[:, None], moved + motion, moved)
            q = torch.where((touches & ~pushes)[:, None], q, ahead)
        states.append(q)
        displacements.append(moved)
    return torch.stack(states, 1), torch.stack(displacements, 1)


def _place(point_t: Float[Tensor, "E 3"], q: Float[Tensor, "E 3"]) -> Float[Tensor, "E 3"]:
    cos, sin = q[:, 2].cos(), q[:, 2].sin()
    x, y = point_t[:, 0], point_t[:, 1]
    return torch.stack((cos * x - sin * y + q[:, 0], sin * x + cos * y + q[:, 1], torch.zeros_like(x)), -1)


def gathered(
    information: VoxelGrid,
    points_t: Float[Tensor, "M 3"],
    configurations: Float[Tensor, "R H 3"],
    displacements: Float[Tensor, "R H 3"],
) -> Float[Tensor, "R"]:
    """Information of the distinct cells that each rollout's points meet (RUMI, Eq 29): `torch.unique`, one by one."""
    wide, deep, layers = information.shape
    if layers != 1:
        raise ValueError(f"Expected a planar field, got {layers} layers")
    # a border of worthless cells takes in what lies outside
    worth = torch.nn.functional.pad(information.values[:, :, 0], (1, 1, 1, 1)).reshape(-1)
    scale = torch.full_like(information.origin, 1.0 / information.spacing)
    matrix = placement(points_t, scale, 1.5 - information.origin * scale)
    features = planar_features(configurations, displacements)
    x = (features @ matrix[..., 0]).clamp_(0.0, wide + 1.0).long()
    y = (features @ matrix[..., 1]).clamp_(0.0, deep + 1.0).long()
    cell = x * (deep + 2) + y
    return torch.stack([worth[torch.unique(row)].sum() for row in cell])


def reach_cost(
    information: VoxelGrid, reachability: VoxelGrid, displacements: Float[Tensor, "R H 3"]
) -> Float[Tensor, "R"]:
    """RUMI's Alg 8: the whole field is moved along with the object for every displacement, and summed."""
    centres = information.centers().reshape(-1, 3)
    r, total = reachability.values.flatten(), information.values.sum()
    shares = [(information.interpolate(centres - path[:, None]) * r).sum(-1).mean() / total for path in displacements]
    return -torch.stack(shares)
