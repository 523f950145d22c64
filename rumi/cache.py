"""Folder that keeps what takes long to work out: reach tables, grasp tables, distance grids."""

import os
from pathlib import Path


def cache_folder() -> Path:
    """The folder: $RUMI_CACHE, else `rumi` in the user's cache. It need not be there yet."""
    own = os.environ.get("RUMI_CACHE")
    if own:
        return Path(own)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rumi"
