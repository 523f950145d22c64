"""What forces felt, in the shapes that a belief takes: touched points with normals, surface points, contact signals."""

import math

from jaxtyping import Bool, Float, Int
from torch import Tensor

from sdf import se3
from sdf.base import SDF
from sdf.mesh.triangles import Triangles
from sensors.force.force_torque import WrenchContact, WrenchStatus
from sensors.observation import Observation
from sensors.semantics import Semantics
from sensors.touch.contact_model import ContactModel, ContactReadings
from sensors.touch.touch_likelihood import Touches, TouchNoise


def wrench_touches(
    contact: WrenchContact,
    world_T_sensor: Float[Tensor, "K 4 4"],
    triangles: Triangles,
    *,
    shape_m: float = 0.001,
    turn_rad: float = math.radians(2.0),
    outlier: float = 0.02,
) -> Touches:
    """Readings that are touches, as evidence on the touched object's pose; the others are left out.

    The touched object's normal is the opposite of the tool's. All touches share one noise: the root mean square of
    what the wrenches' noise makes, with what is not the sensor's.

    Args:
        contact: of K readings.
        world_T_sensor: (K, 4, 4), the sensor at each.
        triangles: of the object, in its own frame.
        shape_m: standard deviation of what else moves points: the tool's shape, the arm's calibration.
        turn_rad: the same of normals.
        outlier: share of touches that tell nothing.
    """
    kept, points, normals = _felt(contact, world_T_sensor)
    point_m, normal_rad = shape_m, turn_rad
    if len(kept):
        spread = contact.covariance[kept].diagonal(dim1=-2, dim2=-1).sum(-1).mean() / 2.0
        point_m = math.hypot(shape_m, math.sqrt(float(spread)))
        normal_rad = math.hypot(turn_rad, math.sqrt(float(contact.normal_sd_rad[kept].square().mean())))
    return Touches(points, normals, triangles, TouchNoise(point_m, normal_rad, outlier))


def wrench_observation(
    contact: WrenchContact, world_T_sensor: Float[Tensor, "K 4 4"]
) -> tuple[Observation, Int[Tensor, "M"]]:
    """Readings that are touches, as surface points in the world frame that ride with the object; and their instants."""
    kept, points, _ = _felt(contact, world_T_sensor)
    return Observation.of(points, Semantics.SURFACE), kept


def _felt(contact: WrenchContact, world_T_sensor: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Which readings are touches; their points and the touched object's normals in the world."""
    kept = (contact.status == int(WrenchStatus.CONTACT)).nonzero()[:, 0]
    pose = world_T_sensor.to(contact.point_s)[kept]
    points = se3.apply(pose, contact.point_s[kept, None])[:, 0]
    return kept, points, -se3.rotate(pose, contact.normal_s[kept, None])[:, 0]


def signal_weight(interval_s: float, gain: float) -> float:
    """What one of many signals counts for whose errors last as long as the observer remembers.

    Noise in a residual of gain K is correlated by rho = exp(-K interval) from one reading to the next; n such readings
    are as good as n (1 - rho) / (1 + rho) independent ones (large n).

    Args:
        interval_s: from one reading to the next.
        gain: of the momentum observer, 1/s.
    """
    if not (interval_s > 0 and gain > 0):
        raise ValueError(f"Expected an interval and a gain above 0, got {interval_s} and {gain}")
    return math.tanh(0.5 * gain * interval_s)


def torque_readings(
    contact: Bool[Tensor, "*b K"],
    points_w: Float[Tensor, "*b K M 3"],
    sdf: SDF,
    model: ContactModel | None = None,
    weight: float = 1.0,
) -> ContactReadings:
    """Contact signals of joint torques as evidence: the whole arm feels, so that its points should be of all links.

    Args:
        contact: (*b, K), signals (`sensors.force.momentum_observer.TorqueThreshold`).
        points_w: (*b, K, M, 3), points on the robot's surface at each instant, metres.
        sdf: of the object.
        model: rates of the signal, as measured for this arm; the paper's by default.
        weight: of one reading (`signal_weight`).
    """
    return ContactReadings(sdf, points_w, contact, model or ContactModel(), weight)
