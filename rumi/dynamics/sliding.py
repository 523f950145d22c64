"""Quasi-static sliding of a touched object: ellipsoidal limit surface and Coulomb contact, one small motion at a time.

Slow pushing: inertia plays no part, and the floor's friction resists the object's twist by a wrench on an ellipsoid,
f^2 + (m / c)^2 = const, of which c is a length. Twists are normal to it, so that a contact force f at the lever r from
the centre of friction gives the twist (f, r x f / c^2) up to a factor.

Real supports have other limit surfaces: with mu = m / c, the convex quartic (f'Af + mu^2)^2 + mu^2 f'Qf = const, whose
normals are found on the friction cone by a root. A, of determinant 1, says in which direction the object slides more
easily; Q how forces and moments trade off: a rod, pushed across, gives way sooner (Q > 0) than the ellipsoid has it.
Zhou, Paolini, Bagnell, Mason (ICRA 2016) fit such quartics to measured wrenches.
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

# share of its frictionless value below which the stiffness against a sliding contact is not let fall: where the
# friction at the contact would wedge the object, there is no quasi-static motion
_WEDGED = 0.1

_STICKS = 10.0  # friction beyond which nothing changes
_RIM = 0.95  # share of the rim that the pressure goes at most: beyond it the object would tip over
_ROOTS = 8  # steps of the Illinois method, which finds the force that moves a sticking contact as it is wanted


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

    def to(self, like: Tensor) -> "Outline":
        """Itself, or a copy, on the device and of the dtype of a tensor."""
        ...


class Sliding(NamedTuple):
    """Parameters of sliding; one value or one for each object.

    Attributes:
        centre: (*b, 2), centre of friction in the object's frame, metres.
        lever: (*b), c: ratio of the greatest friction moment to the greatest friction force, metres.
        friction: (*b), coefficient between tool and object.
        quartic: (*b, 5), of a quartic limit surface, object frame: log A's deviator (xx, xy), and Q's mean eigenvalue
            and deviator (xx, xy); None for the ellipsoid, which all zeros are too.
    """

    centre: Float[Tensor, "*b 2"]
    lever: Float[Tensor, "*b"]
    friction: Float[Tensor, "*b"]
    quartic: Float[Tensor, "*b 5"] | None = None

    def expand(self, *batch: int) -> "Sliding":
        """The same for every element of a batch."""
        quartic = None if self.quartic is None else self.quartic.expand(*batch, 5)
        return Sliding(self.centre.expand(*batch, 2), self.lever.expand(batch), self.friction.expand(batch), quartic)

    def at(self, rows: Tensor) -> "Sliding":
        """Those of some rows."""
        return self.map(lambda part: part[rows])

    def to(self, like: Tensor) -> "Sliding":
        """A copy on the device and of the dtype of a tensor."""
        return self.map(lambda part: part.to(like, non_blocking=True))

    def map(self, change: Callable[[Tensor], Tensor]) -> "Sliding":
        """The same change of every part."""
        quartic = None if self.quartic is None else change(self.quartic)
        return Sliding(change(self.centre), change(self.lever), change(self.friction), quartic)


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


def quartic_twist(
    lever_arm: Float[Tensor, "*b 2"],
    inward: Float[Tensor, "*b 2"],
    wanted: Float[Tensor, "*b 2"],
    lever: Float[Tensor, "*b"],
    friction: Float[Tensor, "*b"],
    quartic: Float[Tensor, "*b 5"],
) -> Float[Tensor, "*b 3"]:
    """`contact_twist` with a quartic limit surface, whose axes are those of the arguments.

    As the force turns from one edge of the friction cone to the other, so does the contact point's motion, the normal
    of a convex curve: where neither edge moves it as wanted or beyond, a force between does.
    """
    x, y = lever_arm.unbind(-1)
    across = torch.stack((-inward[..., 1], inward[..., 0]), -1)
    forward, aside = (wanted * inward).sum(-1), (wanted * across).sum(-1)
    first, second, mean, level, slant = quartic.unbind(-1)
    size = torch.hypot(first, second)
    stretch = torch.where(size > 1e-9, size.sinh() / size.clamp_min(1e-9), torch.ones_like(size))
    a_xx, a_yy, a_xy = size.cosh() + stretch * first, size.cosh() - stretch * first, stretch * second

    def moved(edge: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Twist by the force inward + edge across, how far it moves the contact inward, and how much too far aside."""
        fx, fy = (inward + edge[..., None] * across).unbind(-1)
        moment = (x * fy - y * fx) / lever
        ax, ay = a_xx * fx + a_xy * fy, a_xy * fx + a_yy * fy
        bx, by = (mean + level) * fx + slant * fy, slant * fx + (mean - level) * fy
        whole, half = ax * fx + ay * fy + moment * moment, 0.5 * moment * moment
        vx, vy = whole * ax + half * bx, whole * ay + half * by
        turn = (whole + 0.5 * (bx * fx + by * fy)) * moment / lever
        ux, uy = vx - turn * y, vy + turn * x
        normal = ux * inward[..., 0] + uy * inward[..., 1]
        tangential = ux * across[..., 0] + uy * across[..., 1]
        return torch.stack((vx, vy, turn), -1), normal, aside * normal - tangential * forward

    high = friction.clamp_max(_STICKS)
    low = -high
    least, most = moved(low)[2], moved(high)[2]
    force = torch.where(least <= 0, low, high)
    sticks, side = (least > 0) & (most < 0), torch.zeros_like(low)
    for _ in range(_ROOTS):
        spread = most - least
        edge = (low * most - high * least) / torch.where(spread == 0, torch.ones_like(spread), spread)
        gap = moved(edge)[2]
        above = gap > 0
        low, high = torch.where(above, edge, low), torch.where(above, high, edge)
        # the end that stays twice is drawn in
        most = torch.where(above, torch.where(side > 0, 0.5 * most, most), gap)
        least = torch.where(above, gap, torch.where(side < 0, 0.5 * least, least))
        side = torch.where(above, 1.0, -1.0).to(side)
        force = torch.where(sticks, edge, force)
    twist, normal, _ = moved(force)
    straight = moved(torch.zeros_like(low))[1]
    twist = (forward / torch.maximum(normal, _WEDGED * straight))[..., None] * twist
    most, size = wanted.norm(dim=-1) / _WEDGED, twist[..., :2].norm(dim=-1)
    return torch.where(size > most, most / size, torch.ones_like(size))[..., None] * twist


def gathered(
    share: Float[Tensor, "*b"], arm: Float[Tensor, "*b"], lever: Float[Tensor, "*b"]
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    """Shift of the pressure's centre under what rests on its rim as it is pushed, and the lever about there, metres.

    A push at the height h tips the object towards its rim ahead, while friction n at a contact d behind the centre
    holds that side down: by the balance of moments the pressure's centre goes ahead by a = m (h - n d), m being the
    floor's friction. All pressure is on the rim, so that by the parallel axis theorem c^2 = R^2 - a^2, with R the lever
    at rest: what stands on the edge of its rim turns about it.

    Args:
        share: m; below 0 nothing shifts.
        arm: h - n d, likewise.
        lever: R.
    """
    ahead = torch.minimum(share.clamp_min(0.0) * arm.clamp_min(0.0), _RIM * lever)
    return ahead, (lever.square() - ahead.square()).sqrt()


def turned_quartic(quartic: Float[Tensor, "*b 5"], angle: Float[Tensor, "*b"]) -> Float[Tensor, "*b 5"]:
    """A quartic limit surface of an object that is turned, radians: deviators turn by twice the angle."""
    double = 2.0 * angle
    return torch.cat((rotated(quartic[..., :2], double), quartic[..., 2:3], rotated(quartic[..., 3:], double)), -1)


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
    thickness: float | Float[Tensor, "E"] = 0.0,
    size: Float[Tensor, "E"] | None = None,
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
        thickness: radius of a disc about every point, metres: one point with a radius is a round finger; of each
            object's tool, where these differ. A negative one is how deep its points go in before they touch.
        size: factor of each outline's; None for 1.
        passes: contacts that are settled, at most.
    """
    factor = pose.new_ones(len(pose)) if size is None else size
    thick = thickness if isinstance(thickness, Tensor) else pose.new_full((len(pose),), thickness)
    start, touched = pose, torch.zeros(len(pose), dtype=torch.bool, device=pose.device)
    rows = torch.arange(len(pose), device=pose.device)
    placed = after[:, None, :2] + rotated(points_t, after[:, None, 2])
    for _ in range(passes):
        here, own = pose[rows], sliding.at(rows)
        local = rotated(placed[rows] - here[:, None, :2], -here[:, None, 2])
        local = local / factor[rows, None, None]
        depth, index = (thick[rows, None] - factor[rows, None] * outline(local).distance).max(-1)
        hit = (depth > 0).nonzero()[:, 0]
        if not len(hit):
            break
        rows, here, own, depth, index = rows[hit], here[hit], own.at(hit), depth[hit], index[hit]
        touched[rows] = True
        gradient = outline(local[hit, index]).gradient
        inward = -rotated(gradient / gradient.norm(dim=-1, keepdim=True).clamp_min(1e-9), here[:, 2])
        point = placed[rows, index] + thick[rows, None] * inward
        moved = pushed_out(here, start[rows], before[rows], after[rows], Touch(point, inward, depth), own)
        pose = pose.index_copy(0, rows, moved)
    return pose, touched


class Touch(NamedTuple):
    """Deepest point of a tool in an object.

    Attributes:
        point: (*b, 2), in the world, metres.
        inward: (*b, 2), unit normal into the object.
        depth: (*b), metres.
    """

    point: Float[Tensor, "*b 2"]
    inward: Float[Tensor, "*b 2"]
    depth: Float[Tensor, "*b"]


def pushed_out(
    here: Float[Tensor, "E 3"],
    first: Float[Tensor, "E 3"],
    before: Float[Tensor, "E 3"],
    after: Float[Tensor, "E 3"],
    touch: Touch,
    own: Sliding,
) -> Float[Tensor, "E 3"]:
    """Poses after the deepest point of a tool is settled.

    Args:
        here: poses now.
        first: the same before the tool's motion.
        before: (x, y, yaw) of the tool then.
        after: the same now.
        touch: the point.
        own: sliding of each object.
    """
    point, inward, depth = touch
    # how far the tool's and the object's touched points have gone in this motion
    carried = before[:, :2] + rotated(point - after[:, :2], before[:, 2] - after[:, 2])
    own_old = first[:, :2] + rotated(point - here[:, :2], first[:, 2] - here[:, 2])
    slip = own_old - carried
    slip = slip - (slip * inward).sum(-1, keepdim=True) * inward
    arm = point - here[:, :2] - rotated(own.centre, here[:, 2])
    wanted = depth[:, None] * inward + slip
    if own.quartic is None:
        twist = contact_twist(arm, inward, wanted, own.lever, own.friction)
    else:
        quartic = turned_quartic(own.quartic, here[:, 2])
        twist = quartic_twist(arm, inward, wanted, own.lever, own.friction, quartic)
    return moved_by(here, twist, own.centre)
