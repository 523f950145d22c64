"""Find the pose of an object by touching and pushing it (RUMI, arXiv 2408.10450).

The loop is `rumi.loop.rummage`; the parts it is made of lie in `rumi.belief`, `rumi.registration`, `rumi.fields`,
`rumi.dynamics` and `rumi.planning`, and each can be used alone.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rumi.assemble import build
    from rumi.config import preset
    from rumi.loop import rummage
    from rumi.recording import load_run

__version__ = "0.1.0"
__all__ = ["build", "load_run", "preset", "rummage"]

_HOMES = {"build": "rumi.assemble", "preset": "rumi.config", "rummage": "rumi.loop", "load_run": "rumi.recording"}


def __getattr__(name: str) -> object:
    """The public functions, loaded when they are first asked for: `import rumi` alone stays light."""
    if name not in _HOMES:
        raise AttributeError(f"module 'rumi' has no attribute {name!r}; it has {', '.join(__all__)}")
    found = getattr(import_module(_HOMES[name]), name)
    globals()[name] = found
    return found
