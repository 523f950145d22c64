"""The fused CPU version of the maximum over a disc; `contact.py` has the definition."""

from sdf.compiled import Kernel
from sdf.part_numba import indices


def _spread(values, widths, margin, result, part):
    rows, columns = values.shape
    middle = len(widths) // 2
    for x in indices(part, len(result)):
        found = result[x]
        for row in range(len(widths)):
            source = x + row - 2 * middle
            if widths[row] >= 0 and 0 <= source < rows:
                for shift in range(margin - widths[row], margin + widths[row] + 1):
                    for y in range(columns):
                        found[y + shift] = max(found[y + shift], values[source, y])


spread = Kernel(_spread, fast=True)
