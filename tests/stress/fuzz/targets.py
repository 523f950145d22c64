"""All targets of fuzz by name."""

from collections.abc import Callable, Iterable

from torch import Tensor

from tests.stress.fuzz.asked import ASKED
from tests.stress.fuzz.draw import Draw
from tests.stress.fuzz.files import FILES
from tests.stress.fuzz.functions import FUNCTIONS
from tests.stress.fuzz.recordings import RECORDINGS

TARGETS: dict[str, Callable[[Draw], Iterable[Tensor]]] = {**FUNCTIONS, **FILES, **RECORDINGS, **ASKED}
"""Functions, files, and what users ask for."""
