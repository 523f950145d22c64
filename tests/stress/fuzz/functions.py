"""Public functions under tensors of any value, by subject: documented errors, or finite numbers from finite ones."""

from tests.stress.fuzz import beliefs, geometry, planning, sensing, touching  # noqa: F401  (enter their targets)
from tests.stress.fuzz.entered import FUNCTIONS

__all__ = ["FUNCTIONS"]
