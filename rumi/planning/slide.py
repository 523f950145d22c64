"""Slide policy: the heuristic baseline that follows the object's surface (RUMI, V-H)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.fields.normal import expected_normal
from rumi.planning.policy import Plan, PlanRequest, Scene
from sdf import se3
from sdf.bounds import Checked, NotNegative, ShareAbove0
from sdf.so3 import wrap
from sensors.semantics import Semantics

CLOCKWISE, COUNTER_CLOCKWISE = "clockwise", "counter-clockwise"

_TINY = 1e-6
# metres: points that are this much farther from the pads than the nearest one belong to the same contact
_PATCH = 0.005


@dataclass(frozen=True)
class SlideSettings(Checked):
    """Settings of the heuristic; the paper gives none.

    Attributes:
        stride: share of the greatest translation that an action takes.
        press: part of a sliding motion that goes into the surface, as a share of the part along it; 0 is the paper's.
        face: turn the tool towards the centre on the way there, and towards the surface in contact, so that the
            contact stays on the pads; False keeps its yaw.
    """

    stride: ShareAbove0 = 1.0
    press: NotNegative = 0.0
    face: bool = False


class SlidePolicy:
    """Towards the object until it is felt, then along its surface. A `Policy`; holds settings only.

    Out of contact the tool moves towards the mean over the particles of the surface's centre, not beyond it; in
    contact (at the last instant of the last action) along the horizontal tangent of the mean surface normal where it
    is felt. Whether that goes clockwise about the object, seen from above, is drawn at the first plan of a run, which
    hands it on to the next by `Plan.info`. Configurations are a position, in the plane or in space, and a yaw. A
    decision takes a millisecond, whatever the budget.

    Args:
        settings: stride, press and yaw of the motions.
    """

    def __init__(self, settings: SlideSettings | None = None) -> None:
        self.settings = settings or SlideSettings()

    @torch.no_grad()
    def act(self, request: PlanRequest) -> Plan:
        """Decide on one action; see `rumi.planning.policy.Policy`.

        Raises:
            ValueError: the scene has no reading to tell contact by.
        """
        belief, scene, previous = request.belief, request.scene, request.previous
        if scene.reading is None:
            raise ValueError("Expected scene.reading, by which sliding knows of contact, got None: give the last one")
        turn = None if previous is None else previous.info.get("turn")
        if turn is None:
            heads = torch.rand((), generator=request.generator, device=request.generator.device) < 0.5
            turn = CLOCKWISE if bool(heads) else COUNTER_CLOCKWISE
        configuration = scene.configuration
        centre = estimated_centre(belief, scene)
        felt = bool(scene.reading.in_contact[-1])
        if felt:
            normal = contact_normal(belief, scene, centre)
            motion = self._along(normal, turn == CLOCKWISE, scene)
            towards = -normal
        else:
            motion = self._approach(centre, scene)
            towards = centre[:2] - configuration[:2]
        control = torch.cat((motion / scene.tool.scale[:-1], self._turned(towards, scene))).clamp(-1.0, 1.0)
        reached, _ = scene.tool.free_step(configuration, control)
        info = {"turn": turn, "mode": "slide" if felt else "approach"}
        return Plan(control[None], torch.stack((configuration, reached)), info=info)

    def _approach(self, centre: Float[Tensor, "3"], scene: Scene) -> Float[Tensor, "D"]:
        """Motion, metres, towards the centre and not beyond; a planar tool has no height to change."""
        scale = scene.tool.scale[:-1]
        way = (centre.to(scale) - scene.tool.pose(scene.configuration)[:3, 3])[: len(scale)]
        # all of it if no part asks for more than the stride
        share = (way.abs() / (self.settings.stride * scale)).amax()
        return way / share.clamp_min(1.0)

    def _along(self, normal: Float[Tensor, "2"], clockwise: bool, scene: Scene) -> Float[Tensor, "D"]:
        """Motion, metres, along a surface of a given normal, and into it by the press."""
        scale = scene.tool.scale[:-1]
        x, y = normal.unbind()
        tangent = torch.stack((y, -x) if clockwise else (-y, x))
        way = torch.zeros_like(scale)
        way[:2] = tangent - self.settings.press * normal
        return self.settings.stride * scale * way / way.norm()

    def _turned(self, towards: Float[Tensor, "2"], scene: Scene) -> Float[Tensor, "1"]:
        """Control of the yaw that points the tool's x axis at something."""
        none = scene.configuration.new_zeros(1)
        if not self.settings.face or float(towards.norm()) < _TINY:
            return none
        wanted = torch.atan2(towards[1], towards[0]) - scene.configuration[-1]
        return (wrap(wanted) + none) / scene.tool.scale[-1]


def estimated_centre(belief: PoseBelief, scene: Scene) -> Float[Tensor, "3"]:
    """Mean over the particles of the middle of the object's surface points, world frame."""
    middle = scene.model.surface_points.mean(0).to(belief.log_weights)
    return (belief.weights[:, None] * se3.apply(belief.world_T_object, middle[None])[:, 0]).sum(0)


def contact_normal(belief: PoseBelief, scene: Scene, centre: Float[Tensor, "3"]) -> Float[Tensor, "2"]:
    """Horizontal unit normal of the surface where it is felt, outward.

    The mean over the particles of the normal at the felt points' middle; where they do not agree on any, or it is
    vertical, the direction from the centre to there.
    """
    where = _contact_place(scene).to(belief.log_weights)
    poses, log_weights = belief.world_T_object, belief.log_weights
    mean = expected_normal(scene.model.sdf, poses, log_weights, where[None])[0, :2]
    for way in (mean, (where - centre)[:2]):
        length = way.norm()
        if float(length) > 1e-2 * (1.0 if way is mean else _PATCH):
            return way / length
    yaw = scene.configuration[-1]
    return -torch.stack((yaw.cos(), yaw.sin()))


def _contact_place(scene: Scene) -> Float[Tensor, "3"]:
    """Middle of the surface points of the last instant that lie nearest to the pads; the pads' where there are none."""
    reading, pads = scene.reading, scene.tool.info_points(scene.configuration)
    assert reading is not None
    observation = reading.observation
    last = observation.of_class(Semantics.SURFACE) & (reading.instant == len(reading.in_contact) - 1)
    points = observation.points[last].to(pads)
    if len(points) == 0:
        return pads.mean(0)
    # a camera may have seen other points at the same instant
    away = torch.cdist(points, pads).amin(-1)
    return points[away <= away.min() + _PATCH].mean(0)
