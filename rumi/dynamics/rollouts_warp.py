"""What the Warp versions of rollouts share."""

import torch
from torch import Tensor

from sdf import gpu

wp = gpu.warp()


@gpu.Kernel
def _duplicates(contact: wp.array3d(dtype=wp.bool), duplicate_of: wp.array2d(dtype=wp.int64)):
    k, m = wp.tid()
    for other in range(m, -1, -1):
        touched = bool(False)
        for h in range(contact.shape[2]):
            touched = touched or contact[k, other, h]
        if not touched:
            duplicate_of[k, m] = wp.int64(other)
        elif other == m:
            duplicate_of[k, m] = wp.int64(m)
            break


def duplicates(contact: Tensor) -> Tensor:
    """The first rollout that touches nothing for those that touch nothing; see `base.duplicates`."""
    found = contact.new_empty(contact.shape[:-1], dtype=torch.long)
    rows = contact.reshape(-1, *contact.shape[-2:])
    _duplicates.launch(rows.shape[:2], rows, found.view(rows.shape[:2]))
    return found
