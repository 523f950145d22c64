"""All targets of fuzz by name."""

from collections.abc import Callable, Iterable

from torch import Tensor

from rumi.stress.fuzz.asked import ASKED
from rumi.stress.fuzz.draw import Draw
from rumi.stress.fuzz.files import FILES
from rumi.stress.fuzz.functions import FUNCTIONS
from rumi.stress.fuzz.recordings import RECORDINGS

TARGETS: dict[str, Callable[[Draw], Iterable[Tensor]]] = {**FUNCTIONS, **FILES, **RECORDINGS, **ASKED}
"""Functions, files, and what users ask for."""
