"""Quasi-static sliding of a touched object: ellipsoidal limit surface and Coulomb contact, one small motion at a time.

Slow pushing: inertia plays no part, and the floor's friction resists the object's twist by a wrench on an ellipsoid,
f^2 + (m / c)^2 = const, of which c is a length. Twists are normal to it, so that a contact force f at the lever r from
the centre of friction gives the twist (f, r x f / c^2) up to a factor.
"""

from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

# share of its frictionless value below which the stiffness against a sliding contact is not let fall: where the
# friction at the contact would wedge the object, there is no quasi-static motion
_WEDGED = 0.1


class OutlineQuery(NamedTuple):
    """Signed distance to an outline and its gradient at some points.

    Attributes:
        distance: (*b), metres, positive outside.
        gradient: (*b, 2), outward, in the outline's frame.
    """

    distance: Float[Tensor, "*b"]
    gradient: Float[Tensor, "*b 2"]


@runtime_checkable
class Outline(Protocol):
    """Outline of an object at the height of a tool: a closed region of the plane, without cavities."""

    @property
    def radius(self) -> float:
        """Greatest distance of the region from the frame's origin, metres."""
        ...  # abstract: every member has one

    def __call__(self, points_o: Float[Tensor, "*b 2"]) -> OutlineQuery:
        """Signed distance and gradient at points of the object's frame."""
        ...


class Sliding(NamedTuple):
    """Parameters of sliding; one value or one for each object.

    Attributes:
        centre: (*b, 2), centre of friction in the object's frame, metres.
        lever: (*b), c: ratio of the greatest friction moment to the greatest friction force, metres.
        friction: (*b), coefficient between tool and object.
    """

    centre: Float[Tensor, "*b 2"]
    lever: Float[Tensor, "*b"]
    friction: Float[Tensor, "*b"]

    def expand(self, *batch: int) -> "Sliding":
        """The same for every element of a batch."""
        return Sliding(self.centre.expand(*batch, 2), self.lever.expand(batch), self.friction.expand(batch))

    def at(self, rows: Tensor) -> "Sliding":
        """Those of some rows."""
        return Sliding(self.centre[rows], self.lever[rows], self.friction[rows])


def contact_twist(
    lever_arm: Float[Tensor, "*b 2"],
    inward: Float[Tensor, "*b 2"],
    wanted: Float[Tensor, "*b 2"],
    lever: Float[Tensor, "*b"],
    friction: Float[Tensor, "*b"],
) -> Float[Tensor, "*b 3"]:
    """Motion of an object whose contact point moves by `wanted` along the normal, and across it if it sticks.

    The contact sticks while that needs a force within the friction cone. Otherwise the force lies on the cone's edge,
    and the point moves across the normal as that leads it to.

    Args:
        lever_arm: contact point relative to the centre of friction, metres.
        inward: unit normal of the contact, into the object.
        wanted: motion of the contact point, metres; not against `inward`.
        lever: c of the limit surface, metres.
        friction: coefficient of the contact.

    Returns:
        motion of the centre of friction and turn, metres and radians.
    """
    x, y = lever_arm.unbind(-1)
    square = lever * lever
    whole = square + x * x + y * y
    # the inverse of A, the motion of the contact point that a force leads to
    force = torch.stack(
        (
            ((square + x * x) * wanted[..., 0] + x * y * wanted[..., 1]) / whole,
            (x * y * wanted[..., 0] + (square + y * y) * wanted[..., 1]) / whole,
        ),
        -1,
    )
    across = torch.stack((-inward[..., 1], inward[..., 0]), -1)
    normal, tangential = (force * inward).sum(-1), (force * across).sum(-1)
    edge = inward + (friction * tangential.sign())[..., None] * across
    moment = x * edge[..., 1] - y * edge[..., 0]
    turned = x * inward[..., 1] - y * inward[..., 0]
    straight = 1.0 + turned * turned / square
    stiffness = torch.maximum(1.0 + turned * moment / square, _WEDGED * straight)
    sliding = ((wanted * inward).sum(-1) / stiffness)[..., None] * edge
    force = torch.where((tangential.abs() <= friction * normal)[..., None], force, sliding)
    return torch.cat((force, ((x * force[..., 1] - y * force[..., 0]) / square)[..., None]), -1)


def rotated(vectors: Float[Tensor, "*#b 2"], angle: Float[Tensor, "*#b"]) -> Float[Tensor, "*#b 2"]:
    """Vectors turned by an angle, radians."""
    cos, sin = angle.cos(), angle.sin()
    x, y = vectors.unbind(-1)
    return torch.stack((cos * x - sin * y, sin * x + cos * y), -1)


def moved_by(
    pose: Float[Tensor, "*b 3"], twist: Float[Tensor, "*b 3"], centre: Float[Tensor, "*b 2"]
) -> Float[Tensor, "*b 3"]:
    """Pose (x, y, yaw) after a small motion of the centre of friction (world axes at half the turn) and a turn."""
    arm = rotated(centre, pose[..., 2])
    middle = pose[..., :2] + arm + rotated(twist[..., :2], 0.5 * twist[..., 2])
    return torch.cat((middle - rotated(arm, twist[..., 2]), pose[..., 2:] + twist[..., 2:]), -1)


def push(
    pose: Float[Tensor, "E 3"],
    before: Float[Tensor, "E 3"],
    after: Float[Tensor, "E 3"],
    points_t: Float[Tensor, "n 2"],
    outline: Outline,
    sliding: Sliding,
    *,
    thickness: float = 0.0,
    passes: int = 3,
) -> tuple[Float[Tensor, "E 3"], Bool[Tensor, "E"]]:
    """Poses of objects after one small motion of a tool, and whether it met them.

    The tool goes where it wants. In each pass the point that is deepest in the object pushes it out: the touched point
    of the object moves along the normal by the depth, and across it, if the contact sticks, with the tool. Several
    passes settle several contacts; what depth is left is worked off by the next motion.

    Args:
        pose: (x, y, yaw) of each object, metres and radians.
        before: (x, y, yaw) of the tool that each object meets.
        after: the same, after the motion.
        points_t: points of the tool, tool frame, metres.
        outline: of the objects.
        sliding: of each object.
        thickness: radius of a disc about every point, metres: one point with a radius is a round finger.
        passes: contacts that are settled, at most.
    """
    start, touched = pose, torch.zeros(len(pose), dtype=torch.bool, device=pose.device)
    rows = torch.arange(len(pose), device=pose.device)
    placed = after[:, None, :2] + rotated(points_t, after[:, None, 2])
    for _ in range(passes):
        here, own = pose[rows], sliding.at(rows)
        local = rotated(placed[rows] - here[:, None, :2], -here[:, None, 2])
        depth, index = (thickness - outline(local).distance).max(-1)
        hit = (depth > 0).nonzero()[:, 0]
        if not len(hit):
            break
        rows, here, own, depth, index = rows[hit], here[hit], own.at(hit), depth[hit], index[hit]
        touched[rows] = True
        gradient = outline(local[hit, index]).gradient
        inward = -rotated(gradient / gradient.norm(dim=-1, keepdim=True).clamp_min(1e-9), here[:, 2])
        point = placed[rows, index] + thickness * inward
        # how far the tool's and the object's touched points have gone in this motion
        old = before[rows]
        carried = old[:, :2] + rotated(point - after[rows, :2], old[:, 2] - after[rows, 2])
        first = start[rows]
        own_old = first[:, :2] + rotated(point - here[:, :2], first[:, 2] - here[:, 2])
        slip = own_old - carried
        slip = slip - (slip * inward).sum(-1, keepdim=True) * inward
        arm = point - here[:, :2] - rotated(own.centre, here[:, 2])
        twist = contact_twist(arm, inward, depth[:, None] * inward + slip, own.lever, own.friction)
        pose = pose.index_copy(0, rows, moved_by(here, twist, own.centre))
    return pose, touched
