"""Reductions over the lanes of a block in Warp: threads that share one piece of work, of which each takes a part.

A kernel that is launched with `lanes` knows its own from the last index of `warp.tid()`, and their number from
`warp.block_dim()`, 1 on a CPU. All lanes have to come to a reduction: what they branch on before is the same for all.
"""

from typing import Any

from sdf import gpu

wp = gpu.warp()


@wp.func
def least(value: Any):
    """Least of the lanes' values, in each of them."""
    return wp.tile_extract(wp.tile_min(wp.tile(value)), 0)


@wp.func
def greatest(value: Any):
    """Greatest of the lanes' values, in each of them."""
    return wp.tile_extract(wp.tile_max(wp.tile(value)), 0)
