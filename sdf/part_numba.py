"""The iterations of a part of a kernel's loop."""

from sdf.compiled import bare


@bare
def indices(part, count):
    """The iterations of `count` that belong to a part, as `sdf.threads.Part` names it; for all parts, each once."""
    return range(count * part[0] // part[2], count * part[1] // part[2])
