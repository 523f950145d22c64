"""Find the pose of an object by touching and pushing it (RUMI, arXiv 2408.10450).

The loop is `rumi.loop.run`; the parts it is made of lie in `rumi.belief`, `rumi.registration`, `rumi.fields`,
`rumi.dynamics` and `rumi.planning`, and each can be used alone.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rumi.loop import run
    from rumi.runs.folder import load_run
    from rumi.tasks.rummage.build import build
    from rumi.tasks.rummage.settings import preset

__version__ = "0.1.0"
__all__ = ["build", "load_run", "preset", "run"]

_HOMES = {
    "build": "rumi.tasks.rummage.build",
    "preset": "rumi.tasks.rummage.settings",
    "run": "rumi.loop",
    "load_run": "rumi.runs.folder",
}


def __getattr__(name: str) -> object:
    """The public functions, loaded when they are first asked for: `import rumi` alone stays light."""
    if name not in _HOMES:
        raise AttributeError(f"module 'rumi' has no attribute {name!r}; it has {', '.join(__all__)}")
    found = getattr(import_module(_HOMES[name]), name)
    globals()[name] = found
    return found
