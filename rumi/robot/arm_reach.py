"""Reach of any serial arm in a workspace: inverse kinematics at every node of a lattice, by URDF or MJCF."""

import itertools
import json
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.robot.arm import Arm
from rumi.robot.arm_collision import ArmCollision
from rumi.robot.reach import Reach
from rumi.robot.reach_table import ReachSettings, ReachTable
from rumi.robot.robot_file import read_robot
from rumi.seeding import generator
from sdf import se3
from sdf.bounds import Checked, Count, Positive
from sdf.cache import content_key, keep_arrays, load_arrays
from sdf.so3 import wrap

VERSION = 1
"""Of the table's contents: raise it when the same settings give other numbers."""

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ArmReachSettings(Checked, refusal=UsageError):
    """Settings of an arm's reach.

    Attributes:
        spacing_m: between nodes along x and y; layers in height are up to four times as far apart.
        yaw_steps: nodes of a whole turn of the tool.
        round: the tool is the same all about its z axis, as a stick or a ball, so that the arm may turn it as it likes.
        floor: what the object stands on, z = 0, goes on below the arm: no link that moves may be lower.
        rotation_scale_m: metres that a radian of rotation error counts as.
        tolerance_m: a configuration is reachable where its residual is at most this.
        starts: random starts of the inverse kinematics at every third node; the others start from neighbours.
    """

    spacing_m: Positive = 0.025
    yaw_steps: Count = 24
    round: bool = False
    floor: bool = True
    rotation_scale_m: Positive = 0.1
    tolerance_m: Positive = 0.005
    starts: Count = 12


class ArmReach(Reach):
    """`Reach` of any serial arm: a table over (height, x, y, yaw), linear between nodes.

    It supposes nothing of axes, limits or number of joints, nor of how the arm is mounted; so it holds for one
    workspace. Where the arm's collision shapes are known, a node is worth the best solution that was found by which
    the arm meets neither itself nor the floor; metres of penetration count as metres of error.

    Args:
        table: errors at the nodes, each (Z, X, Y, W).
        settings: what it was made with.
        corner: (x, y, z) of the first node.
        steps: metres between nodes along x and y, and between layers.
        base: (x, y, yaw) of the arm's base in the world.
        checked: what was looked at beside kinematics, in words.
    """

    def __init__(
        self,
        table: ReachTable,
        settings: ArmReachSettings,
        corner: Sequence[float],
        steps: tuple[float, float],
        base: tuple[float, float, float],
        checked: str = "",
    ) -> None:
        tolerances = ReachSettings(rotation_scale_m=settings.rotation_scale_m, tolerance_m=settings.tolerance_m)
        super().__init__(table, tolerances, base)
        layers = table.position.shape[0]
        self.corner, self.steps, self.checked = tuple(corner), steps, checked
        self.words = f"of the arm, {100 * self.reached:.0f} % of its table; {checked}"
        self.heights_m = tuple(corner[2] + steps[1] * layer for layer in range(layers)) if layers > 1 else ()

    @classmethod
    def of_urdf(
        cls,
        robot: str | Path,
        tip: str,
        bounds: Float[Tensor, "2 3"],
        *,
        base: tuple[float, float, float] | Float[Tensor, "4 4"] = (0.0, 0.0, 0.0),
        tip_T_tool: Float[Tensor, "4 4"] | None = None,
        packages: Mapping[str, Path] | None = None,
        settings: ArmReachSettings | None = None,
        cache_dir: Path | None = None,
    ) -> Self:
        """Solve the inverse kinematics in a workspace (up to a minute) or take the table from `cache_dir`.

        Args:
            robot: file of the URDF, or its text, which starts with "<".
            tip: the link that carries the tool.
            bounds: (2, 3), lower and upper corner of where the tool frame is to be, such as a workspace's; both at
                one height for a tool in the plane.
            base: where the URDF's root stands in the world: (x, y, yaw) on the floor, or world_T_root.
            tip_T_tool: the tool's frame (x forward, z up when level) in the tip's; None where they are one.
            packages: folders of the packages that `package://` names in the URDF.
            settings: of the table.
            cache_dir: folder to keep the table in; None keeps nothing.

        Raises:
            UsageError: it is no URDF, has no such tip, or joints that cannot be.
        """
        settings = settings or ArmReachSettings()
        text, _ = read_robot(robot)
        arm = Arm(text, tip)
        pose = base if isinstance(base, Tensor) else se3.from_planar(torch.tensor(base, dtype=torch.float64))
        if pose.shape != (4, 4):
            raise UsageError(f"Expected base to be (x, y, yaw) or world_T_root (4, 4), got {tuple(pose.shape)}")
        pose, mount = pose.double(), torch.eye(4).double() if tip_T_tool is None else tip_T_tool.double()
        _check_rigid("base", pose)
        _check_rigid("tip_T_tool", mount)
        if not bool(arm.forward(torch.full((1, len(arm.joints)), 0.1, dtype=torch.float64)).isfinite().all()):
            raise UsageError("Expected joints whose axes and places are finite numbers, and no axis zero, got others")
        collision = ArmCollision.of(robot, arm.joints, pose, packages=packages, floor=settings.floor)
        goals, corner, steps = _goals(bounds, settings)
        numbers = {**asdict(settings), "tip": tip, "corner": corner, "steps": steps, "shape": list(goals.shape)}
        key = content_key(
            json.dumps({"version": VERSION, "checked": collision.words, **numbers}, sort_keys=True),
            text,
            *(part.numpy().tobytes() for part in (pose, mount)),
        )
        kept = None if cache_dir is None else Path(cache_dir) / f"arm-reach-{key}.npz"
        table = None if kept is None else _load(kept, goals.shape[:4])
        if table is None:
            base_T_tip = se3.inverse(pose) @ goals @ se3.inverse(mount)
            table = _solve(arm, base_T_tip, mount[:3, 2].contiguous(), collision.depth, settings)
            if kept is not None:
                keep_arrays(kept, {name: part.numpy() for name, part in table._asdict().items()})
        if settings.round:
            table = ReachTable(*(part.expand(-1, -1, -1, 2).contiguous() for part in table))
        planar = se3.to_planar(pose).tolist()
        return cls(table, settings, corner, steps, (planar[0], planar[1], planar[2]), collision.words)

    @classmethod
    def of_mjcf(
        cls,
        robot: str | Path,
        tip: str,
        bounds: Float[Tensor, "2 3"],
        *,
        base: tuple[float, float, float] | Float[Tensor, "4 4"] = (0.0, 0.0, 0.0),
        tip_T_tool: Float[Tensor, "4 4"] | None = None,
        settings: ArmReachSettings | None = None,
        cache_dir: Path | None = None,
    ) -> Self:
        """The same of an MJCF model, read by MuJoCo; `tip` is a body or a site; see `of_urdf`.

        Args:
            robot: file of the MJCF, or its text. Boxes, spheres, cylinders and capsules that collide are its shapes.
            tip: the body or site that carries the tool.
            bounds: as for `of_urdf`.
            base: where MJCF's world is in rumi's.
            tip_T_tool: as for `of_urdf`.
            settings: of the table.
            cache_dir: folder to keep the table in.

        Raises:
            UsageError: it is no MJCF, has no such tip, or joints that cannot be.
        """
        from rumi.robot.mjcf import urdf_of_mjcf

        return cls.of_urdf(
            urdf_of_mjcf(robot, tip),
            "tip",
            bounds,
            base=base,
            tip_T_tool=tip_T_tool,
            settings=settings,
            cache_dir=cache_dir,
        )

    @property
    def reached(self) -> float:
        """Share of the table's nodes that are reached."""
        return float((self.left <= self.settings.tolerance_m).float().mean())

    @property
    def nodes(self) -> tuple[float, ...]:
        """Where the table's nodes are, for `tool_numba`."""
        step, rise = self.steps
        turn = 2.0 * math.pi / (self.position.shape[-1] - 1)
        return (self.corner[2], rise, self.corner[0], self.corner[1], step, turn)

    def errors(self, q: Float[Tensor, "*b Q"]) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
        """Position error (m) and rotation error (rad) that remain at configurations."""
        (position, rotation), beyond = self._values(torch.stack((self.position, self.rotation)), q)
        return position + beyond, rotation

    def residual(self, q: Float[Tensor, "*b Q"]) -> Float[Tensor, "*b"]:
        """See `Reach.residual`."""
        (left,), beyond = self._values(self.left[None], q)
        return left + beyond

    def _values(self, tables: Float[Tensor, "C Z X Y W"], q: Tensor) -> tuple[Tensor, Tensor]:
        """Multilinear values (C, *b), and metres beyond the table (*b)."""
        low, rise, left, bottom, step, turn = self.nodes
        height = (q[..., 2] - low) / rise if q.shape[-1] == 4 else torch.zeros_like(q[..., 0])
        yaw = (wrap(q[..., -1]) + math.pi) / turn
        place = torch.stack((height, (q[..., 0] - left) / step, (q[..., 1] - bottom) / step, yaw), -1)
        last = place.new_tensor([n - 1.0 for n in tables.shape[1:]])
        inside = torch.minimum(place.clamp_min(0.0), last)
        corner = torch.minimum(inside.floor(), (last - 1.0).clamp_min(0.0))
        share = inside - corner
        total = place.new_zeros(len(tables), *place.shape[:-1])
        for ends in itertools.product((0, 1), repeat=4):
            end = torch.tensor(ends, device=q.device)
            k, i, j, w = torch.minimum(corner + end, last).long().unbind(-1)
            total = total + torch.where(end > 0, share, 1.0 - share).prod(-1) * tables[:, k, i, j, w]
        return total, step * (place - inside)[..., 1:3].abs().sum(-1)

    def _oriented(self, points_w: Tensor, yaws: Sequence[float]) -> Float[Tensor, "*b R Q"]:
        planar = super()._oriented(points_w, yaws)
        if not self.heights_m:
            return planar
        height = points_w[..., None, 2:].expand(*planar.shape[:-1], 1)
        return torch.cat((planar[..., :2], height, planar[..., 2:]), -1)


def _check_rigid(name: str, pose: Float[Tensor, "4 4"]) -> None:
    turn = pose[:3, :3]
    rigid = bool(pose.isfinite().all()) and float((turn @ turn.mT - torch.eye(3).to(turn)).abs().max()) < 1e-3
    if not rigid or float(torch.linalg.det(turn)) < 0:
        raise UsageError(f"Expected {name} to turn and shift alone, with finite numbers, got {pose.tolist()}")


def _goals(
    bounds: Float[Tensor, "2 3"], settings: ArmReachSettings
) -> tuple[Float[Tensor, "Z X Y W 4 4"], list[float], tuple[float, float]]:
    """world_T_tool at every node, the first node's (x, y, z), and the steps along x and y and in height."""
    low, high = bounds.double().cpu()
    counts = [max(2, math.ceil(float(high[axis] - low[axis]) / settings.spacing_m - 1e-6) + 1) for axis in (0, 1)]
    tall = float(high[2] - low[2])
    layers = 1 if tall == 0 else max(2, math.ceil(tall / (4.0 * settings.spacing_m)) + 1)
    step, rise = settings.spacing_m, tall / (layers - 1) if layers > 1 else 1.0
    turns = 1 if settings.round else settings.yaw_steps + 1
    axes = [
        low[2] + rise * torch.arange(layers).double(),
        *(low[axis] + step * torch.arange(counts[axis]).double() for axis in (0, 1)),
        -math.pi + 2.0 * math.pi / settings.yaw_steps * torch.arange(turns).double(),
    ]
    z, x, y, yaw = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).unbind(-1)
    return se3.from_planar(torch.stack((x, y, yaw), -1), z), low.tolist(), (step, rise)


def _solve(
    arm: Arm,
    goals: Float[Tensor, "Z X Y W 4 4"],
    axis: Float[Tensor, "3"],
    depth: Callable[[Tensor], Tensor],
    settings: ArmReachSettings,
) -> ReachTable:
    """Errors at every node: many starts at every third one, then from neighbours that are better off."""
    shape, flat, joints = goals.shape[:4], goals.reshape(-1, 4, 4), len(arm.joints)
    best = torch.full((len(flat),), torch.inf, dtype=torch.float64)
    found, left = best.new_zeros(len(flat), joints), best.new_zeros(2, len(flat))

    def attempt(rows: Tensor, starts: Tensor, iterations: int) -> None:
        """Solve at some nodes, and keep what is better there; a node may come several times."""
        result = arm.solve(
            flat[rows],
            starts,
            rotation_scale_m=settings.rotation_scale_m,
            iterations=iterations,
            tolerance_m=1e-4,
            about=axis if settings.round else None,
        )
        error = result.position_error + settings.rotation_scale_m * result.rotation_error
        position = result.position_error.clone()
        near = (error <= settings.tolerance_m).nonzero()[:, 0]
        position[near] += depth(result.joints[near])
        cost = position + settings.rotation_scale_m * result.rotation_error
        least = torch.full_like(best, torch.inf).scatter_reduce(0, rows, cost, "amin")
        first = torch.full((len(flat),), len(rows)).scatter_reduce(
            0, rows, torch.where(cost <= least[rows], torch.arange(len(rows)), len(rows)), "amin"
        )
        better = ((least < best) & (first < len(rows))).nonzero()[:, 0]
        chosen = first[better]
        best[better], found[better] = cost[chosen], result.joints[chosen]
        left[0, better], left[1, better] = position[chosen], result.rotation_error[chosen]

    index = torch.arange(len(flat)).reshape(shape)
    coarse = index[:, ::3, ::3, ::3].reshape(-1)
    low, high = arm.low.clamp_min(-math.pi), arm.high.clamp_max(math.pi)
    unit = torch.rand(settings.starts, joints, generator=generator(0), dtype=torch.float64)
    starts = torch.cat((0.5 * (low + high)[None], low + (high - low) * (0.1 + 0.8 * unit)))
    _logger.info("solving the arm's reach: %d nodes", len(flat))
    for start in starts:
        attempt(coarse, start.expand(len(coarse), -1), 30)
    near = torch.stack(torch.meshgrid(*(torch.arange(n) for n in shape), indexing="ij"), -1)
    near[..., 1:] = torch.minimum((near[..., 1:] + 1) // 3 * 3, (torch.tensor(shape[1:]) - 1) // 3 * 3)
    attempt(index.reshape(-1), found[index[*near.unbind(-1)].reshape(-1)], 20)
    # where that did not do, from neighbours where it did, for as long as this helps
    for _ in range(6):
        good = (best <= settings.tolerance_m).reshape(shape)
        rows, sources = [], []
        for along, way in itertools.product(range(4), (-1, 1)):
            ahead = index.roll(way, along)
            lacks = ~good & good.roll(way, along) & ((index - ahead).abs() <= max(1, index.stride(along)))
            rows.append(index[lacks])
            sources.append(ahead[lacks])
        before = int(good.sum())
        if sum(map(len, rows)):
            attempt(torch.cat(rows), found[torch.cat(sources)], 20)
        if int((best <= settings.tolerance_m).sum()) <= before:
            break
    return ReachTable(left[0].reshape(shape), left[1].reshape(shape))


def _load(path: Path, shape: Sequence[int]) -> ReachTable | None:
    arrays = load_arrays(path, ReachTable._fields)
    if arrays is None or any(tuple(array.shape) != tuple(shape) for array in arrays.values()):
        return None
    return ReachTable(*(torch.from_numpy(arrays[name]) for name in ReachTable._fields))
