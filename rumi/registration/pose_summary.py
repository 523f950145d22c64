"""Pose summary: best pose of a posterior, its covariance and its modes, as other programs and people take them.

Poses are world_T_object. A covariance is that of ROS: of (x, y, z) of the object's origin (metres) and of turns about
the world's fixed x, y and z axes (radians), in this order, second moments about the pose that it stands beside.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.columns import folded
from sdf import se3, so3
from sdf.symmetry import Symmetries

COVARIANCE_ORDER = "x y z (m) of the object's origin, then turns about the world's fixed x y z (rad)"
_MODES = 8  # that are told apart at most
_PARTICLES = 200  # that modes are looked for among
_ROWS = 25  # of them whose distances to all others are had at once
_NEAR_M, _NEAR_RAD = 0.01, 0.175  # of one mode, as `PoseBelief.mode` has it
_LEAST = 0.01  # weight of a mode that is told


@dataclass(frozen=True, eq=False)
class PoseMode:
    """A cluster of like poses.

    Attributes:
        world_T_object: (4, 4), float64.
        weight: of the whole posterior.
        covariance: (6, 6), see above.
    """

    world_T_object: Float[Tensor, "4 4"]
    weight: float
    covariance: Float[Tensor, "6 6"]

    @property
    def spread_m(self) -> float:
        """Standard deviation of the place in the direction in which it is largest."""
        return _largest(self.covariance[:3, :3])

    @property
    def spread_rad(self) -> float:
        """Standard deviation of the turn about the axis about which it is largest."""
        return _largest(self.covariance[3:, 3:])

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {
            **pose_dict(self.world_T_object),
            "weight": self.weight,
            "covariance": self.covariance.tolist(),
            "spread_mm": 1e3 * self.spread_m,
            "spread_deg": math.degrees(self.spread_rad),
        }

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """What `as_dict` gave."""
        return cls(_tensor(values["world_T_object"]), float(values["weight"]), _tensor(values["covariance"]))


@dataclass(frozen=True, eq=False)
class PoseSummary:
    """What a posterior knows of a pose.

    Attributes:
        world_T_object: (4, 4), float64, the best pose.
        covariance: (6, 6) of the whole posterior about it, each pose as the nearest of those that look the same.
        probability: mass of the posterior within both tolerances of it. A belief of particles is narrower than what is
            known: this is no frequency of being right.
        within_m, within_rad: the tolerances.
        modes: the heaviest first; the first is the best pose's.
    """

    world_T_object: Float[Tensor, "4 4"]
    covariance: Float[Tensor, "6 6"]
    probability: float
    within_m: float
    within_rad: float
    modes: tuple[PoseMode, ...]

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {
            "frame": "world",
            **pose_dict(self.world_T_object),
            "covariance": self.covariance.tolist(),
            "covariance_order": COVARIANCE_ORDER,
            "probability": self.probability,
            "within_mm": 1e3 * self.within_m,
            "within_deg": math.degrees(self.within_rad),
            "calibrated": False,
            "modes": [mode.as_dict() for mode in self.modes],
        }

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """What `as_dict` gave."""
        return cls(
            _tensor(values["world_T_object"]),
            _tensor(values["covariance"]),
            float(values["probability"]),
            1e-3 * values["within_mm"],
            math.radians(values["within_deg"]),
            tuple(PoseMode.of(mode) for mode in values["modes"]),
        )

    def lines(self) -> list[str]:
        """For people."""
        found = [
            *pose_lines(self.world_T_object, self.covariance),
            f"believed {self.probability:.2f} within {1e3 * self.within_m:g} mm and "
            f"{math.degrees(self.within_rad):g} degrees (the belief's mass, uncalibrated)",
        ]
        for mode in self.modes[1:4]:
            metres, radians = se3.distance(mode.world_T_object, self.world_T_object)
            x, y, z = mode.world_T_object[:3, 3].tolist()
            found.append(
                f"or       ({x:.4f}, {y:.4f}, {z:.4f}) m with {mode.weight:.2f}: {1e3 * float(metres):.0f} mm and "
                f"{math.degrees(float(radians)):.0f} degrees away"
            )
        return found


def summarise_particles(
    world_T_object: Float[Tensor, "N 4 4"],
    log_weights: Float[Tensor, "N"],
    best: Float[Tensor, "4 4"] | None = None,
    symmetries: Symmetries | None = None,
    *,
    within_m: float = 0.005,
    within_rad: float = math.radians(10.0),
) -> PoseSummary:
    """What weighted poses know.

    Modes are found greedily: the pose with most weight within 10 mm and 10 degrees, then that of what is left.

    Args:
        world_T_object: of the particles.
        log_weights: of the particles, normalised or not.
        best: the best pose; by default the mean of the heaviest mode.
        symmetries: turns after which the object looks the same.
        within_m: what `PoseSummary.probability` is for, metres.
        within_rad: the same, radians.

    Raises:
        ValueError: no particles.
    """
    if len(log_weights) == 0:
        raise ValueError("Expected at least one particle, got 0")
    own = (symmetries or Symmetries.none()).to(torch.float64)
    poses, weights = se3.renormalised(world_T_object.detach().double().cpu()), log_weights.detach().double().cpu()
    weights = weights.softmax(-1)
    few, shares = poses, weights
    if len(poses) > _PARTICLES:  # each stands for an equal share
        comb = (torch.arange(_PARTICLES, dtype=torch.float64) + 0.5) / _PARTICLES
        few = poses[torch.searchsorted(weights.cumsum(0), comb).clamp_max(len(poses) - 1)]
        shares = torch.full((_PARTICLES,), 1.0 / _PARTICLES, dtype=torch.float64)
    pairs = [(few.repeat(len(some), 1, 1), some.repeat_interleave(len(few), 0)) for some in few.split(_ROWS)]
    together = torch.cat([_within(every, one, own).reshape(-1, len(few)) for every, one in pairs])
    left, modes = torch.ones(len(few), dtype=torch.bool), list[PoseMode]()
    while bool(left.any()) and len(modes) < _MODES:
        # ties go to the heavier particle
        heaviest = int(((together & left).double() @ shares + 1e-6 * shares).masked_fill(~left, -1.0).argmax())
        near = together[heaviest] & left
        middle = se3.mean(own.nearest(few[near], few[heaviest].expand(int(near.sum()), 4, 4)), shares[near] + 1e-300)
        if best is not None and not modes:
            middle = se3.renormalised(best.detach().double().cpu())
            near = (_within(few, middle, own) & left) if bool(_within(few, middle, own).any()) else near
        if modes and float(shares[near].sum()) < _LEAST:
            break
        modes.append(PoseMode(middle, float(shares[near].sum()), moments(few[near], shares[near], middle, own)))
        left = left & ~near
    at = modes[0].world_T_object
    probability = mass_within(poses, weights, at, own, within_m, within_rad)
    return PoseSummary(at, moments(poses, weights, at, own), probability, within_m, within_rad, tuple(modes))


def mass_within(
    poses: Float[Tensor, "N 4 4"],
    weights: Float[Tensor, "N"],
    at: Float[Tensor, "4 4"],
    own: Symmetries,
    within_m: float,
    within_rad: float,
) -> float:
    """Weight of the poses that are, as the nearest that looks the same, within both tolerances of one."""
    return min(1.0, float(weights[_within(poses, at, own, within_m, within_rad)].sum()))


def moments(
    poses: Float[Tensor, "N 4 4"], weights: Float[Tensor, "N"], about: Float[Tensor, "4 4"], own: Symmetries
) -> Float[Tensor, "6 6"]:
    """Weighted second moments about a pose, along the world's axes; poses as the nearest that look the same."""
    alike = own.nearest(poses, about.expand(len(poses), 4, 4))
    away = torch.cat((alike[:, :3, 3] - about[:3, 3], so3.log(alike[:, :3, :3] @ about[:3, :3].mT)), -1)
    share = weights / weights.sum().clamp_min(1e-300)
    return away.mT @ (share[:, None] * away)


def pose_dict(world_T_object: Float[Tensor, "4 4"]) -> dict[str, Any]:
    """A pose as a matrix, and as position and quaternion (x, y, z, w)."""
    return {
        "world_T_object": world_T_object.tolist(),
        "position_m": world_T_object[:3, 3].tolist(),
        "quaternion_xyzw": so3.quaternion(world_T_object[:3, :3]).tolist(),
    }


def pose_lines(world_T_object: Float[Tensor, "4 4"], covariance: Float[Tensor, "6 6"]) -> list[str]:
    """A pose and its standard deviations, for people."""
    x, y, z = world_T_object[:3, 3].tolist()
    turn = " ".join(f"{value:.4f}" for value in so3.quaternion(world_T_object[:3, :3]).tolist())
    yaw = math.degrees(float(torch.atan2(world_T_object[1, 0], world_T_object[0, 0])))
    wide = covariance.diagonal().clamp_min(0.0).sqrt()
    metres = " ".join(f"{1e3 * value:.1f}" for value in wide[:3].tolist())
    degrees = " ".join(f"{math.degrees(value):.1f}" for value in wide[3:].tolist())
    return [
        f"pose     x {x:.4f} y {y:.4f} z {z:.4f} m, in the world's frame",
        f"turn     {turn} (quaternion x y z w; yaw {yaw:.1f} degrees)",
        f"spread   {metres} mm along x y z, {degrees} degrees about them",
    ]


def answer_lines(pose: PoseSummary | None, why_not: str | None, warnings: Sequence[str]) -> list[str]:
    """The lines of an answer, for people: the pose, why it is not sure, and what may have made it wrong."""
    found = [] if pose is None else pose.lines()
    if why_not is not None:
        found += folded(f"not sure: {why_not}")
    return found + [line for warning in warnings for line in folded(f"warning  {warning}")]


def _within(
    poses: Float[Tensor, "N 4 4"],
    at: Float[Tensor, "*n 4 4"],
    own: Symmetries,
    within_m: float = _NEAR_M,
    within_rad: float = _NEAR_RAD,
) -> Bool[Tensor, "N"]:
    """Whether each pose, as the nearest that looks the same, is within 10 mm and 10 degrees of `at`, or as asked."""
    there = at.expand(len(poses), 4, 4)
    metres, radians = se3.distance(own.nearest(poses, there), there)
    return (metres <= within_m) & (radians <= within_rad)


def _largest(block: Float[Tensor, "3 3"]) -> float:
    return math.sqrt(max(float(torch.linalg.eigvalsh(block)[-1]), 0.0))


def _tensor(values: Any) -> Tensor:  # noqa: ANN401  (nested lists of numbers)
    return torch.tensor(values, dtype=torch.float64)
