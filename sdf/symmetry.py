"""Rotational symmetry groups of objects."""

import math
import re
from dataclasses import dataclass, field, replace
from typing import Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sdf import se3, so3
from sdf.check import check_shape, is_eager

_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
SAME_RAD = math.radians(3.0)
"""Rotations nearer to each other than this count as one."""

_MOST = 120  # rotations of the largest finite group that is no cyclic or dihedral one are 60


def _origin() -> Float[Tensor, "3"]:
    return torch.zeros(3)


@dataclass(frozen=True, eq=False)
class Symmetries:
    """A group of rotations about one point.

    Attributes:
        rotations: (K, 3, 3), the identity first; of those that differ by a turn about `axis`, one.
        center: (3,), the point that they leave where it is, metres, object frame.
        axis: (3,), unit: any turn about it leaves the object as it is too; None where there is none.
        ball: whether every rotation does.
    """

    rotations: Float[Tensor, "K 3 3"]
    center: Float[Tensor, "3"] = field(default_factory=_origin)
    axis: Float[Tensor, "3"] | None = None
    ball: bool = False

    def __post_init__(self) -> None:
        """Refuse what is no list of rotations with the identity first."""
        check_shape("rotations", self.rotations, "(K, 3, 3)")
        check_shape("center", self.center, "(3,)")
        first = self.rotations[:1]
        if len(first) == 0 or (is_eager() and not torch.allclose(first[0], torch.eye(3).to(first), atol=1e-5)):
            raise ValueError("Expected rotations to begin with the identity: put torch.eye(3) first")

    @classmethod
    def none(cls) -> Self:
        """The identity alone."""
        return cls(torch.eye(3)[None])

    @classmethod
    def parse(cls, text: str, center: Float[Tensor, "3"] | None = None) -> Self:
        """Symmetries in words: `none`, `ball`, or generators with commas between.

        A generator is an axis, x, y or z, with the order of the turns about it, and without a number for any turn:
        `z4,x2` is a square prism upright, `z,x2` a cylinder, `x2,y2` a box.

        Args:
            text: the words.
            center: (3,), the point that they leave where it is, metres; the origin by default.

        Raises:
            ValueError: another word, or axes and orders that no object can have together.
        """
        middle = torch.zeros(3) if center is None else center
        words = [word.strip() for word in text.split(",")]
        if words in (["none"], ["ball"]):
            return cls(torch.eye(3)[None], middle, ball=words == ["ball"])
        found = [re.fullmatch(r"([xyz])(\d*)", word) for word in words]
        if not all(found) or any(match and match[2] and int(match[2]) < 2 for match in found):
            raise ValueError(
                f"Expected symmetries to be none, ball, or axes with an order of 2 or more such as z, z4 or x2,y2, "
                f"got {text!r}"
            )
        free = {match[1] for match in found if match and not match[2]}
        if len(free) > 1:
            return cls(torch.eye(3)[None], middle, ball=True)
        axis = torch.tensor(_AXES[free.pop()]) if free else None
        turns = [
            so3.exp(torch.tensor(_AXES[match[1]], dtype=torch.float64) * (2 * math.pi / int(match[2])))
            for match in found
            if match and match[2]
        ]
        rotations = closure(torch.stack(turns) if turns else torch.eye(3, dtype=torch.float64)[None], axis)
        if rotations is None:
            raise ValueError(f"Expected turns that an object can have together, got {text!r}: see x2,y2 or z4,x2")
        return cls(rotations.to(middle), middle, None if axis is None else axis.to(middle))

    def __len__(self) -> int:
        return len(self.rotations)

    @property
    def trivial(self) -> bool:
        """Whether the identity is all there is."""
        return len(self) == 1 and self.axis is None and not self.ball

    def to(self, *targets: torch.device | torch.dtype | str | Tensor) -> Self:
        """The same on another device or in another dtype."""
        moved = self
        for target in targets:
            axis = None if moved.axis is None else moved.axis.to(target)
            moved = replace(moved, rotations=moved.rotations.to(target), center=moved.center.to(target), axis=axis)
        return moved

    def nearest(self, pose: Float[Tensor, "*b 4 4"], like: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
        """Of the poses at which the object is as at `pose`, the one whose rotation is nearest to that of `like`.

        Args:
            pose: world_T_object.
            like: world_T_object.
        """
        if self.trivial:
            return pose
        own = self.to(pose)
        if self.ball:
            turned = pose[..., :3, :3].mT @ like[..., :3, :3]
            return pose @ about(turned, own.center)
        turns = own.rotations
        if own.axis is None:  # the trace of R turn is the sum of the products of R's transpose and turn
            transposed = pose[..., :3, :3].mT @ like[..., :3, :3]
            best = (transposed.flatten(-2) @ turns.flatten(-2).mT).argmax(-1)
            return pose @ about(turns, own.center)[best]
        back = like[..., None, :3, :3].mT @ (pose[..., None, :3, :3] @ turns)
        free = self._best_turn(back, own.axis)
        turns, back = turns @ free, back @ free
        traces = back.diagonal(dim1=-2, dim2=-1).sum(-1)
        best = traces.argmax(-1)[..., None, None, None].expand(*traces.shape[:-1], 1, 3, 3)
        chosen = torch.gather(turns.expand(*traces.shape, 3, 3), -3, best)[..., 0, :, :]
        return pose @ about(chosen, own.center)

    @staticmethod
    def _best_turn(back: Float[Tensor, "*b 3 3"], axis: Float[Tensor, "3"]) -> Float[Tensor, "*b 3 3"]:
        """The turn about an axis after which a rotation is nearest to none.

        The trace of R exp(t hat(a)) is a' R a + cos t (tr R - a' R a) + sin t tr(R hat(a)).
        """
        along = ((back @ axis) * axis).sum(-1)
        cosine = back.diagonal(dim1=-2, dim2=-1).sum(-1) - along
        sine = (back * so3.hat(axis).mT).sum((-2, -1))
        return so3.exp(torch.atan2(sine, cosine)[..., None] * axis)

    def words(self) -> str:
        """For people: what turns about which axes."""
        if self.ball:
            return "any rotation"
        orders: list[tuple[Tensor, int]] = []
        for rotation in self.rotations[1:].double():
            line = _upper(torch.nn.functional.normalize(so3.log(rotation), dim=0))
            for index, (other, order) in enumerate(orders):
                if float((other @ line).abs()) > math.cos(SAME_RAD):
                    orders[index] = (other, order + 1)
                    break
            else:
                orders.append((line, 2))
        if self.axis is not None:
            flips = " and half a turn about any line across it" if orders else ""
            return f"any turn about {_line(_upper(self.axis))}{flips}"
        parts = []
        for order in sorted({order for _, order in orders}, reverse=True):
            lines = [_line(line) for line, other in orders if other == order]
            parts.append(f"{_turn(order)} about {' or '.join(lines)}")
        return ", ".join(parts) or "none"


def about(rotation: Float[Tensor, "*b 3 3"], center: Float[Tensor, "3"]) -> Float[Tensor, "*b 4 4"]:
    """The transform that rotates about a point."""
    return se3.make(rotation, center - (rotation @ center[:, None])[..., 0])


def closure(rotations: Float[Tensor, "N 3 3"], axis: Float[Tensor, "3"] | None = None) -> Float[Tensor, "K 3 3"] | None:
    """All products of some rotations, the identity first; None where they are too many.

    Args:
        rotations: (N, 3, 3); those nearer to each other than 3 degrees count as one.
        axis: (3,), unit: those that differ by a turn about it count as one too.
    """
    group = torch.eye(3).to(rotations)[None]
    new = rotations
    while len(new):
        # of those that are alike, the first; of those that are known, none
        alike = _alike(new, torch.cat((group, new)), axis)
        first = alike.long().argmax(-1) == len(group) + torch.arange(len(new), device=new.device)
        group, new = torch.cat((group, new[first])), new[first]
        if len(group) > _MOST:
            return None
        new = (new[:, None] @ rotations).reshape(-1, 3, 3)
    return group


def _alike(a: Float[Tensor, "N 3 3"], b: Float[Tensor, "M 3 3"], axis: Tensor | None) -> Bool[Tensor, "N M"]:
    if axis is None:
        return torch.einsum("nij,mij->nm", a, b) > 1.0 + 2.0 * math.cos(SAME_RAD)
    line = axis.to(a)
    return (a @ line) @ (b @ line).mT > math.cos(SAME_RAD)


def _upper(line: Tensor) -> Tensor:
    """Of a line's two directions, the one whose last large part is positive."""
    large = [float(x) for x in line if abs(float(x)) > 1e-3]
    return -line if large and large[-1] < 0 else line


def _line(line: Tensor) -> str:
    return "(" + ", ".join(f"{round(float(x), 2) + 0.0:.2f}" for x in line) + ")"


def _turn(order: int) -> str:
    return {2: "half a turn", 3: "a third of a turn", 4: "a quarter of a turn"}.get(order, f"a turn's 1/{order}")
