"""One package from outside, on whose members the contracts hold too."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from rumi.belief.evidence import EVIDENCE
from rumi.dynamics.registry import PUSH_MODELS
from rumi.planning.registry import POLICIES

OUTSIDE = Path(__file__).resolve().parents[1] / "fixtures" / "outside"


@pytest.fixture(scope="module")
def outside() -> Iterator[None]:
    """The package as an installer would leave it: its members are found by their entry points."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(OUTSIDE)
        for table in (EVIDENCE, POLICIES, PUSH_MODELS):
            table.__dict__.pop("_outside", None)
        yield
    for table in (EVIDENCE, POLICIES, PUSH_MODELS):
        table.__dict__.pop("_outside", None)
