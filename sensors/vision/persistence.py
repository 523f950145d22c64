"""Temporal filter of depth pixels: those that have shown the same surface for long enough."""

import math
from dataclasses import dataclass
from typing import NamedTuple, Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


class PersistentSurface(NamedTuple):
    """Persistent surface of a depth image.

    Attributes:
        lasting: (H, W), pixels that have shown one surface for long enough.
        depth: (H, W), metres, there the mean depth since the surface came; elsewhere 0.
    """

    lasting: Bool[Tensor, "H W"]
    depth: Float[Tensor, "H W"]


@dataclass(frozen=True)
class Persistence:
    """Memory of the persistence filter: the age of each pixel's surface; goes from one frame's call to the next.

    Kept for the n pixels alone that show something.

    Attributes:
        shape: (H, W) of the images.
        pixel: (n), in rows one after the other.
        depth: (n), metres, mean since the surface came.
        count: (n), frames in that mean.
        since: (n), stamp of the frame in which it came, seconds.
        last: (n), stamp of the last frame that showed it.
        stamp: of the last frame.
    """

    shape: tuple[int, int]
    pixel: Int[Tensor, "n"]
    depth: Float[Tensor, "n"]
    count: Float[Tensor, "n"]
    since: Float[Tensor, "n"]
    last: Float[Tensor, "n"]
    stamp: float

    @classmethod
    def start(cls, height: int, width: int) -> Self:
        """Nothing was seen yet."""
        none, times = torch.zeros(0, dtype=torch.float32), torch.zeros(0, dtype=torch.float64)
        return cls((height, width), torch.zeros(0, dtype=torch.long), none, none, times, times, -math.inf)

    def seen(
        self,
        depth: Float[Tensor, "H W"],
        surface: Bool[Tensor, "H W"],
        stamp: float,
        *,
        window_s: float = 0.4,
        tolerance_m: float = 0.01,
        gap_s: float = 0.1,
    ) -> tuple[Self, PersistentSurface]:
        """Take in a frame.

        Args:
            depth: (H, W), metres.
            surface: (H, W), pixels that show the object and can be relied on.
            stamp: seconds; must not go back.
            window_s: for how long a pixel must have shown a surface, to a hundredth of that.
            tolerance_m: by which a frame's depth may differ from the mean to be the same surface.
            gap_s: for which it may be missing in between, to a hundredth too.

        Returns:
            what to hand to the next call, and what this frame shows that has lasted.

        Raises:
            ValueError: an image of another size, or a stamp before the last.
        """
        if tuple(depth.shape) != self.shape or surface.shape != depth.shape:
            raise ValueError(
                f"Expected images of {self.shape}, got depth {tuple(depth.shape)} and surface {tuple(surface.shape)}"
            )
        if not stamp >= self.stamp:
            raise ValueError(f"Expected stamps that do not go back, got {stamp} after {self.stamp}")
        depth = depth.float()
        recent = stamp - self.last <= 1.01 * gap_s
        now = surface.reshape(-1).nonzero()[:, 0]
        # row of the memory that each pixel has, -1 for none
        row = torch.full((depth.numel(),), -1, dtype=torch.long)
        row[self.pixel[recent]] = recent.nonzero()[:, 0]
        own, found = row[now], depth.reshape(-1)[now]
        met = own >= 0
        old = own.clamp_min(0)
        if len(self.pixel):
            same = met & ((found - self.depth[old]).abs() <= tolerance_m)
            count = torch.where(same, self.count[old] + 1.0, 1.0)
            before = torch.where(same, self.depth[old], found)
            since = torch.where(same, self.since[old], stamp)
        else:
            count, before = torch.ones_like(found), found
            since = torch.full_like(found, stamp, dtype=torch.float64)
        mean = before + (found - before) / count
        # what is missing in this frame alone waits for the next
        row[now] = -1
        waits = row[self.pixel[recent]]
        waits = waits[waits >= 0]
        state = type(self)(
            self.shape,
            torch.cat((now, self.pixel[waits])),
            torch.cat((mean, self.depth[waits])),
            torch.cat((count, self.count[waits])),
            torch.cat((since, self.since[waits])),
            torch.cat((torch.full_like(since, stamp), self.last[waits])),
            stamp,
        )
        lasting = stamp - since >= 0.99 * window_s
        shown, mask = torch.zeros_like(depth.reshape(-1)), torch.zeros(depth.numel(), dtype=torch.bool)
        mask[now] = lasting
        shown[now[lasting]] = mean[lasting]
        return state, PersistentSurface(mask.reshape(self.shape), shown.reshape(self.shape))
