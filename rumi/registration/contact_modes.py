"""Modes of a pose posterior: clusters of poses with weights and uncertainties."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.registration.pose_summary import COVARIANCE_ORDER, PoseMode, pose_lines
from sdf import se3, so3
from sdf.symmetry import Symmetries

_SUSPECT = 3.0  # times the noise
FEWEST, FEWEST_WITH_NORMALS = 20, 8
"""Touches from which weights were right with one bad one among them (scripts/docs/how-to/localize.md)."""


@dataclass(frozen=True, eq=False)
class Localization:
    """All plausible poses, the heaviest first.

    A mode stands for all poses that the object's symmetries make alike: world_T_object @ S for each S of them, a whole
    family where they have an axis.

    Attributes:
        world_T_object: (M, 4, 4), of the mesh's own frame.
        weights: (M,), which add up to 1: likelihood times the volume that the mode fills.
        distance_m: (M,), mean distance of the points from the surface.
        normal_rad: (M,), mean angle between normals and the faces that explain the touches; None without normals.
        log_likelihood: (M,), nats, up to a constant.
        covariance: (M, 6, 6), of the middle of the object's box (metres) and of its turn (radians), world frame; turns
            about an axis of symmetry count as none. `mode` has that of the mesh's origin.
        open_directions: (M,), of the six, those of which the touches say next to nothing.
        symmetries: of the object.
        noise_m: scale of the points' noise that the weights and the covariance are of.
        found: how many modes were plausible, of which the heaviest are here.
        points: how many there were.
        off_m: (M, K), distance of each of them from the surface.
        left_out: (K), whether a point is too far from the others to be on the object, and was not used.
        middle_o: (3,), middle of the object's box, in the mesh's own frame.
    """

    world_T_object: Float[Tensor, "M 4 4"]
    weights: Float[Tensor, "M"]
    distance_m: Float[Tensor, "M"]
    normal_rad: Float[Tensor, "M"] | None
    log_likelihood: Float[Tensor, "M"]
    covariance: Float[Tensor, "M 6 6"]
    open_directions: Int[Tensor, "M"]
    symmetries: Symmetries
    noise_m: float
    found: int
    points: int
    off_m: Float[Tensor, "M K"]
    left_out: Bool[Tensor, "K"]
    middle_o: Float[Tensor, "3"]

    def __len__(self) -> int:
        return len(self.weights)

    @property
    def best(self) -> int:
        """Which mode has the likeliest pose: without normals that of the least distance; the weights may differ."""
        return int(self.log_likelihood.argmax())

    @property
    def spread_m(self) -> Float[Tensor, "M"]:
        """Standard deviation of the middle's place in the direction in which it is largest."""
        return torch.linalg.eigvalsh(self.covariance[:, :3, :3])[:, -1].clamp_min(0.0).sqrt()

    @property
    def spread_rad(self) -> Float[Tensor, "M"]:
        """Standard deviation of the turn about the axis about which it is largest."""
        return torch.linalg.eigvalsh(self.covariance[:, 3:, 3:])[:, -1].clamp_min(0.0).sqrt()

    @property
    def suspects(self) -> list[int]:
        """Which points the best pose leaves farther off than three times the noise, the farthest first."""
        off = self.off_m[self.best]
        far = ((off > _SUSPECT * self.noise_m) | self.left_out).nonzero()[:, 0]
        return [int(k) for k in far[off[far].argsort(descending=True, stable=True)]]

    @property
    def trusted(self) -> bool:
        """Whether there were as many points as weights can be trusted from (`fewest`)."""
        return self.points >= self.fewest

    @property
    def fewest(self) -> int:
        """Points from which the weights can be trusted, one bad one among them."""
        return FEWEST if self.normal_rad is None else FEWEST_WITH_NORMALS

    def mode(self, index: int) -> PoseMode:
        """A mode with the covariance about the mesh's origin, as `rumi result` has those of a belief."""
        pose = self.world_T_object[index]
        across = torch.eye(6, dtype=pose.dtype)
        across[:3, 3:] = so3.hat(pose[:3, :3] @ self.middle_o)
        return PoseMode(pose, float(self.weights[index]), across @ self.covariance[index] @ across.mT)

    @property
    def family(self) -> bool:
        """Whether every mode is a continuous family: the object looks the same after any turn about an axis."""
        return self.symmetries.axis is not None or self.symmetries.ball

    def alike(self, mode: int, *, turns: int = 36) -> Float[Tensor, "K 4 4"]:
        """The poses that a mode stands for: all of a finite group, or `turns` about the axis for each.

        Args:
            mode: which.
            turns: how many of a continuous family; of a ball's only the pose itself comes.
        """
        own = self.symmetries
        rotations = own.rotations
        if own.axis is not None:
            angles = 2.0 * math.pi * torch.arange(turns, dtype=torch.float64)[:, None] / turns
            rotations = (rotations[:, None] @ so3.exp(angles * own.axis)).flatten(0, 1)
        shift = own.center - (rotations @ own.center[:, None])[..., 0]
        return self.world_T_object[mode] @ se3.make(rotations, shift)

    def to_dict(self) -> dict[str, Any]:
        """Everything, as JSON takes it."""
        own, off = self.symmetries, self.off_m[self.best]
        modes = [
            {
                **self.mode(i).as_dict(),
                "mean_distance_mm": 1e3 * float(self.distance_m[i]),
                "mean_normal_deg": None if self.normal_rad is None else math.degrees(float(self.normal_rad[i])),
                "log_likelihood": float(self.log_likelihood[i]),
                "spread_mm": 1e3 * float(self.spread_m[i]),
                "spread_deg": math.degrees(float(self.spread_rad[i])),
                "open_directions": int(self.open_directions[i]),
            }
            for i in range(len(self))
        ]
        symmetries = {
            "words": own.words(),
            "center": own.center.tolist(),
            "axis": None if own.axis is None else own.axis.tolist(),
            "ball": own.ball,
            "rotations": own.rotations.tolist(),
        }
        return {
            "frame": "world",
            "covariance_order": COVARIANCE_ORDER,
            "points": self.points,
            "weights_from_points": self.fewest,
            "suspects": [
                {"touch": k + 1, "off_mm": 1e3 * float(off[k]), "left_out": bool(self.left_out[k])}
                for k in self.suspects
            ],
            "noise_mm": 1e3 * self.noise_m,
            "found": self.found,
            "best": self.best,
            "family": self.family,
            "symmetries": symmetries,
            "modes": modes,
        }

    def text(self) -> str:
        """For people."""
        count = f"{len(self)} mode{'s' if len(self) != 1 else ''}"
        more = f" of {self.found} plausible ones" if self.found > len(self) else ""
        lines = [f"{count}{more} from {self.points} points; noise taken for {1e3 * self.noise_m:.3g} mm"]
        if not self.symmetries.trivial:
            whole = "; each mode is a family of poses" if self.family else "; each mode is all poses alike by these"
            lines.append(f"object looks the same after: {self.symmetries.words()}{whole}")
        normals = "" if self.normal_rad is None else "  normals"
        lines.append(f"weight  mean off{normals}  spread               origin x, y, z (mm)       quaternion x, y, z, w")
        turns = so3.quaternion(self.world_T_object[:, :3, :3])
        for i in range(len(self)):
            place = " ".join(f"{1e3 * x:8.1f}" for x in self.world_T_object[i, :3, 3].tolist())
            turn = " ".join(f"{x:7.4f}" for x in turns[i].tolist())
            angle = "" if self.normal_rad is None else f"  {math.degrees(float(self.normal_rad[i])):4.1f} deg"
            wide = f"{1e3 * float(self.spread_m[i]):5.1f} mm {math.degrees(float(self.spread_rad[i])):5.1f} deg"
            open_ = f"  {int(self.open_directions[i])} of 6 directions open" if self.open_directions[i] else ""
            lines.append(
                f"{float(self.weights[i]):6.4f}  {1e3 * float(self.distance_m[i]):5.2f} mm{angle}  {wide}  {place}  "
                f"{turn}{open_}"
            )
        lines += ["heaviest:", *pose_lines(self.world_T_object[0], self.mode(0).covariance)]
        if self.suspects:
            off = self.off_m[self.best]
            named = [
                f"{k + 1} ({1e3 * float(off[k]):.3g} mm{', left out' * bool(self.left_out[k])})" for k in self.suspects
            ]
            more = f", and {len(named) - 8} more" if len(named) > 8 else ""
            lines.append(
                f"suspect touches, farther off the best pose than three times the noise: {', '.join(named[:8])}{more}"
            )
        if not self.trusted:
            kind = "points alone" if self.normal_rad is None else "points with normals"
            lines.append(f"weights can be trusted from {self.fewest} {kind} on, one bad one among them: touch more")
        return "\n".join(lines)
