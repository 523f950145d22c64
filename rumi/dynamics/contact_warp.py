"""The Warp version of the bound of a contact field, a thread a node; `contact.py` has the definition."""

from typing import Any

from sdf import gpu

wp = gpu.warp()


@gpu.Kernel
def spread(values: wp.array2d(dtype=Any), widths: wp.array(dtype=wp.int64), result: wp.array2d(dtype=Any)):
    """Greatest value over a footprint: `widths` nodes to each side of its middle in each of its rows, -1 for none."""
    x, y = wp.tid()
    margin, rows = (result.shape[1] - values.shape[1]) // 2, widths.shape[0]
    most = values.dtype(0.0)
    for row in range(rows):
        source, width = x + row - rows + 1, int(widths[row])
        if width >= 0 and source >= 0 and source < values.shape[0]:
            for column in range(wp.max(y - margin - width, 0), wp.min(y - margin + width + 1, values.shape[1])):
                most = wp.max(most, values[source, column])
    result[x, y] = most
