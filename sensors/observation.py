"""Points of space with semantics: the observations that a belief is weighed by."""

from dataclasses import dataclass, replace
from typing import Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sdf import backend, compiled, se3
from sdf.check import check_finite, check_shape, is_eager
from sdf.containers import Ragged, container
from sdf.voxel_grid import BITS, lattice_keys


@container({"points": Ragged(-2), "semantics": Ragged(-1), "attached": Ragged(-1), "valid": Ragged(-1)})
@dataclass(frozen=True)
class Observation:
    """Points with semantics, for any batch of scenes, padded to one length.

    Attributes:
        points: (*b, M, 3), metres; object-attached frame where `attached`, else world frame. (In a `Reading`
            every point is in the world frame.)
        semantics: (*b, M), `Semantics` values.
        attached: (*b, M), True for a point that rides with the object, False for one fixed in the world.
        valid: (*b, M), False for padding.
    """

    points: Float[Tensor, "*b M 3"]
    semantics: Int[Tensor, "*b M"]
    attached: Bool[Tensor, "*b M"]
    valid: Bool[Tensor, "*b M"]

    @classmethod
    def of(cls, points: Float[Tensor, "*b M 3"], semantics: int, *, attached: bool = True) -> Self:
        """All points of one class; refuses points that are not finite."""
        check_shape("points", points, "(*b, M, 3)", last=(3,))
        check_finite("points", points)
        shape = points.shape[:-1]
        return cls(
            points,
            torch.full(shape, int(semantics), dtype=torch.long, device=points.device),
            torch.full(shape, attached, dtype=torch.bool, device=points.device),
            torch.ones(shape, dtype=torch.bool, device=points.device),
        )

    @classmethod
    def empty(
        cls, batch: tuple[int, ...] = (), *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
    ) -> Self:
        """No points at all."""
        return cls.of(torch.zeros(*batch, 0, 3, dtype=dtype, device=device), 0)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Self:
        """Move to a device and a floating dtype."""
        moved = self.points.to(device=device, dtype=dtype)
        device = moved.device
        return replace(
            self,
            points=moved,
            semantics=self.semantics.to(device),
            attached=self.attached.to(device),
            valid=self.valid.to(device),
        )

    def __getitem__(self, index: Tensor) -> Self:
        """The points at `index` (one scene only: no batch axes)."""
        return replace(
            self,
            points=self.points[index],
            semantics=self.semantics[index],
            attached=self.attached[index],
            valid=self.valid[index],
        )

    def __len__(self) -> int:
        """Number of points a scene, padding included."""
        return self.points.shape[-2]

    def of_class(self, semantics: int) -> Bool[Tensor, "*b M"]:
        """Mask of the valid points of one class."""
        return self.valid & (self.semantics == int(semantics))


def concatenate(observations: list[Observation]) -> Observation:
    """All points of some observations of the same batch, one after the other."""
    return Observation(
        torch.cat([o.points for o in observations], dim=-2),
        torch.cat([o.semantics for o in observations], dim=-1),
        torch.cat([o.attached for o in observations], dim=-1),
        torch.cat([o.valid for o in observations], dim=-1),
    )


def attach(
    observation: Observation,
    instant: Int[Tensor, "*b M"],
    world_T_attached: Float[Tensor, "*b K 4 4"],
) -> Observation:
    """Carry the attached points of a reading from the world into the object-attached frame.

    Args:
        observation: points in the world frame, each at its own instant.
        instant: (*b, M), index of each point's instant.
        world_T_attached: (*b, K, 4, 4), the attached frame at each instant.
    """
    # one pass per point, whatever the number of instants: gather each point's own inverse
    inverse = se3.inverse(world_T_attached)
    index = instant[..., None, None].expand(*instant.shape, 4, 4)
    own = torch.gather(inverse, -3, index)
    carried = (own[..., :3, :3] @ observation.points[..., None])[..., 0] + own[..., :3, 3]
    return replace(observation, points=torch.where(observation.attached[..., None], carried, observation.points))


def in_world(observation: Observation, world_T_attached: Float[Tensor, "*b 4 4"]) -> Observation:
    """The observation with its attached points carried to where they are in the world now."""
    carried = se3.apply(world_T_attached.to(observation.points), observation.points)
    return replace(observation, points=torch.where(observation.attached[..., None], carried, observation.points))


def thin_mask(
    observation: Observation, spacing: Float[Tensor, "3"], taken: Int[Tensor, "T"] | None = None
) -> Bool[Tensor, "*b M"]:
    """Which points to keep so that each lattice cell, class and frame holds one: the first.

    The lattice is the world's, `floor(x / spacing)`, not the points' own, so that thinning twice is thinning
    once (RUMI, Alg 6's D, which re-centres, walks a point by millimetres). Raw points are kept, not centres.

    Args:
        observation: the points, earlier ones win.
        spacing: (3,), metres, for free, occupied and surface points.
        taken: keys, by `observation_keys`, of cells that already have a point.
    """
    keys = observation_keys(observation, spacing)
    valid = observation.valid.reshape(-1)
    # a stable sort puts the earliest point of each cell first
    order = torch.argsort(keys, stable=True)
    sorted_keys = keys[order]
    first = torch.ones_like(valid)
    first[1:] = sorted_keys[1:] != sorted_keys[:-1]
    keep = torch.zeros_like(valid)
    keep[order] = first
    keep &= valid
    if taken is not None:
        keep &= ~torch.isin(keys, taken)
    return keep.reshape(observation.valid.shape)


def observation_keys(observation: Observation, spacing: Float[Tensor, "3"]) -> Int[Tensor, "K"]:
    """One integer for each point's scene, class, frame and lattice cell; padding shares the key -1."""
    spacing = spacing.to(observation.points)
    cell = lattice_keys(observation.points, spacing[observation.semantics])
    batch = observation.valid[..., 0].numel() if observation.valid.shape[-1] else 0
    count = observation.valid.shape[-1]
    row = torch.arange(max(batch, 1), device=cell.device).repeat_interleave(count)
    label = (row * 2 + observation.attached.reshape(-1).long()) * 3 + observation.semantics.reshape(-1)
    keys = cell.reshape(-1) + (label << 51) if count else cell.reshape(-1)
    return torch.where(observation.valid.reshape(-1), keys, torch.full_like(keys, -1))


def merge(old: Observation, new: Observation, spacing: Float[Tensor, "3"]) -> tuple[Observation, Observation]:
    """Add new points to old ones, one a lattice cell; the old point of a cell stays (RUMI, Alg 6).

    Nothing is deleted: free points that ride with the object stay true after it moved, where the paper's
    Alg 6, line 3 drops every one that refutes a particle.

    Returns:
        the merged observation and the part of `new` that was added (padding removed where every scene allows).
    """
    check_shape("points", old.points, "(*b, M, 3)")
    check_shape("points", new.points, "(*b, M, 3)")
    version = backend.dispatch("merge", old.points, new.points, spacing)
    added = compact(replace(new, valid=version(old, new, spacing)))
    return compact(concatenate([old, added])), added


@backend.register("merge")
def _added_plain(old: Observation, new: Observation, spacing: Float[Tensor, "3"]) -> Bool[Tensor, "*b M"]:
    """Which of the new points are added."""
    return thin_mask(new, spacing, observation_keys(old, spacing))


@backend.register("merge", "numba", compiled.supports)
def _added_numba(old: Observation, new: Observation, spacing: Float[Tensor, "3"]) -> Bool[Tensor, "*b M"]:
    if new.points.ndim != 2 or old.points.dtype != new.points.dtype:
        return _added_plain(old, new, spacing)
    from sensors.observation_numba import added

    table = torch.full((1 << max(4, (2 * len(new)).bit_length()),), -1, dtype=torch.long)
    keep, wrong = torch.zeros(len(new), dtype=torch.bool), torch.zeros(1, dtype=torch.bool)
    arrays = [
        part.contiguous().numpy()
        for own in (new, old)
        for part in (own.points.detach(), torch.where(own.valid, 3 * own.attached.long() + own.semantics, -1))
    ]
    pitch = spacing.detach().to(new.points).numpy()
    added(
        *arrays,
        pitch,
        1 << (BITS - 1),
        BITS,
        table.numpy(),
        torch.empty_like(table).numpy(),
        keep.numpy(),
        wrong.numpy(),
    )
    return _added_plain(old, new, spacing) if bool(wrong) else keep  # which says what is wrong


def compact(observation: Observation) -> Observation:
    """Move the valid points of each scene to the front, in order, and cut what no scene needs."""
    if len(observation) == 0 or not is_eager() or bool(observation.valid.all()):
        return observation
    if observation.points.ndim == 2:
        return observation[observation.valid.nonzero()[:, 0]]
    longest = int(observation.valid.sum(-1).max())
    order = torch.argsort((~observation.valid).to(torch.uint8), dim=-1, stable=True)[..., :longest]
    return Observation(
        torch.gather(observation.points, -2, order[..., None].expand(*order.shape, 3)),
        torch.gather(observation.semantics, -1, order),
        torch.gather(observation.attached, -1, order),
        torch.gather(observation.valid, -1, order),
    )
