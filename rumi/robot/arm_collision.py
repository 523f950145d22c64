"""Collisions of an arm with itself and with the floor, from the collision shapes of its URDF."""

import itertools
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.robot.robot_file import read_robot
from rumi.robot.tool_shape import border_points
from rumi.robot.urdf import UrdfBody
from rumi.seeding import generator
from sdf import se3

_SAMPLES = 200  # configurations by which it is told which parts always meet
_ALWAYS = 0.9  # of them: parts that meet so often are made so
_CHUNK = 2048


@dataclass(frozen=True)
class ArmCollision:
    """How deep an arm is in itself or below the floor.

    Attributes:
        words: what is looked at, and what is not.
        body: the shapes; None where there are none.
        joints: the arm's, by name.
        world_T_root: (4, 4), of the URDF's root.
        points: of each shape's surface, in its link's frame.
        floor: shapes that may not be below z = 0.
        pairs: shapes that may not meet.
    """

    words: str
    body: UrdfBody | None = None
    joints: Sequence[str] = ()
    world_T_root: Float[Tensor, "4 4"] | None = None
    points: Sequence[Tensor] = ()
    floor: Sequence[int] = ()
    pairs: Sequence[tuple[int, int]] = ()

    @classmethod
    def of(
        cls,
        robot: str | Path,
        joints: Sequence[str],
        world_T_root: Float[Tensor, "4 4"],
        *,
        packages: Mapping[str, Path] | None = None,
        floor: bool = True,
    ) -> "ArmCollision":
        """Of a URDF. Links that a joint joins are not held against each other, nor what nearly always meets.

        Args:
            robot: file of the URDF, or its text.
            joints: the arm's, by name; others stay at 0.
            world_T_root: (4, 4), of the URDF's root.
            packages: folders of the packages that `package://` names.
            floor: whether the floor is below the arm.
        """
        try:
            body = UrdfBody.load(robot, packages=packages)
        except (UsageError, ImportError) as error:
            return cls(f"neither self-collision nor the floor is checked: {error}")
        shapes = body.body.links
        points = [border_points(shape, max(0.01, shape.diagonal / 12.0)).float() for shape in shapes]
        made = cls("", body, tuple(joints), world_T_root.float(), points)
        unit = torch.rand(_SAMPLES, len(joints), generator=generator(0))
        low, high = _limits(body, joints)
        poses = made.poses(low + (high - low) * unit)
        moving = [not torch.allclose(pose, pose[:1].expand_as(pose), atol=1e-6) for pose in poses.unbind(1)]
        groups = _groups(robot)
        pairs = [
            (a, b)
            for a, b in itertools.combinations(range(len(shapes)), 2)
            if (moving[a] or moving[b]) and (body.owners[a], body.owners[b]) not in groups
        ]
        meets = {pair: float((made._pair(poses, *pair) > 0).float().mean()) for pair in pairs}
        below = [k for k in range(len(shapes)) if floor and moving[k]]
        sunk = {k: float((made._sunk(poses, k) > 0).float().mean()) for k in below}
        pairs = [pair for pair in pairs if meets[pair] < _ALWAYS]
        below = [k for k in below if sunk[k] < _ALWAYS]
        tail = f"the floor for {len(below)}" if floor else "no floor"
        words = f"self-collision is checked for {len(pairs)} pairs of shapes, {tail}; nothing else stands about"
        return cls(words, body, made.joints, made.world_T_root, points, below, pairs)

    def poses(self, joints: Float[Tensor, "n J"]) -> Float[Tensor, "n L 4 4"]:
        """World poses of the shapes' links."""
        assert self.body is not None and self.world_T_root is not None
        full = torch.zeros(len(joints), len(self.body.joints))
        for column, name in enumerate(self.joints):
            full[:, self.body.joints.index(name)] = joints[:, column].float()
        found = self.body.chain.forward_kinematics(full)
        # a link that no joint moves comes once
        links = [found[name].get_matrix().expand(len(joints), 4, 4) for name in self.body.owners]
        return self.world_T_root @ torch.stack(links, 1)

    def depth(self, joints: Float[Tensor, "n J"]) -> Float[Tensor, "n"]:
        """Metres of the deepest penetration; 0 where nothing meets, or nothing is checked."""
        if self.body is None or not (self.floor or self.pairs):
            return joints.new_zeros(len(joints))
        return (
            torch.cat([self._depth(part) for part in joints.split(_CHUNK)]).to(joints) if len(joints) else joints[:, 0]
        )

    def _depth(self, joints: Tensor) -> Tensor:
        poses = self.poses(joints)
        found = [self._sunk(poses, k) for k in self.floor] + [self._pair(poses, *pair) for pair in self.pairs]
        return torch.stack(found).amax(0).clamp_min(0.0)

    def _sunk(self, poses: Tensor, shape: int) -> Float[Tensor, "n"]:
        return -se3.apply(poses[:, shape], self.points[shape])[..., 2].amin(-1)

    def _pair(self, poses: Tensor, a: int, b: int) -> Float[Tensor, "n"]:
        assert self.body is not None
        found = []
        for one, other in ((a, b), (b, a)):
            places = se3.apply(se3.inverse(poses[:, other]) @ poses[:, one], self.points[one])
            with torch.no_grad():
                found.append(-self.body.body.links[other].distance(places).amin(-1))
        return torch.maximum(*found)


def _limits(body: UrdfBody, joints: Sequence[str]) -> tuple[Tensor, Tensor]:
    low, high = (torch.as_tensor(side, dtype=torch.float32) for side in body.chain.get_joint_limits())
    order = [body.joints.index(name) for name in joints]
    return low[order].clamp_min(-torch.pi), high[order].clamp_max(torch.pi)


def _groups(robot: str | Path) -> set[tuple[str, str]]:
    """Pairs of links that are one body or joined by one joint, both ways round."""
    root = ElementTree.fromstring(read_robot(robot)[0])
    body = {str(link.get("name")): str(link.get("name")) for link in root.findall("link")}
    joined: set[tuple[str, str]] = set()
    ends = []
    for joint in root.findall("joint"):
        parent, child = (str(end.get("link")) for end in (joint.find("parent"), joint.find("child")) if end is not None)
        ends.append((parent, child))
        if joint.get("type") == "fixed":
            old, new = body[child], body[parent]
            body = {link: new if own == old else own for link, own in body.items()}
    bodies = {(body[parent], body[child]) for parent, child in ends}
    for a, b in itertools.product(body, repeat=2):
        if body[a] == body[b] or (body[a], body[b]) in bodies or (body[b], body[a]) in bodies:
            joined.add((a, b))
    return joined
