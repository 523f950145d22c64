"""What learning code asks of every piece: slopes that are right, transforms, compilation; or a reason why not.

The table of `scripts/docs/how-to/learning.md` is what the pieces in `tests/fixtures/learning_pieces.py` say of it.
"""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.fixtures.learning_checks import ALONE, QUICK, SLOW
from tests.fixtures.learning_pieces import PIECES
from tests.fixtures.piece import Piece

# of torch's own transforms: rules that are compiled by what it is about to give up, or not there yet
pytestmark = [
    pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning"),
    pytest.mark.filterwarnings("ignore:There is a performance drop because we have not yet implemented:UserWarning"),
    pytest.mark.filterwarnings("ignore:.*input value tensor is non-contiguous:UserWarning"),
]
ROOT = Path(__file__).resolve().parents[2]
FEW = ("Discrepancy", "ContactModel, proximity")


def hold(piece: Piece, of: str, check: Callable[[Piece], None]) -> None:
    if of not in piece.cannot:
        check(piece)
        return
    with pytest.raises(Exception):  # noqa: B017  (torch's, of whatever kind)
        check(piece)
        pytest.fail(f"it can now: take {of!r} from what it cannot ({piece.cannot[of]})", pytrace=False)


@pytest.mark.parametrize("name", PIECES)
@pytest.mark.parametrize("of", QUICK)
def test_quick(of: str, name: str) -> None:
    hold(PIECES[name], of, QUICK[of])


@pytest.mark.slow
@pytest.mark.parametrize("name", PIECES)
@pytest.mark.parametrize("of", SLOW)
def test_slow(of: str, name: str) -> None:
    hold(PIECES[name], of, SLOW[of])


def alone(of: str, names: list[str]) -> None:
    """A property of some pieces, in a process whose hints are not enforced."""
    command = [sys.executable, "-m", "tests.fixtures.learning_checks", of, *names]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=1800)
    found = {line.split(" ", 1)[1].rsplit(" ", 1)[0] for line in done.stdout.splitlines() if line.startswith("LACKS")}
    assert done.stdout.count("HOLDS") + len(found) == len(names), done.stderr[-3000:]
    assert found == {name for name in names if of in PIECES[name].cannot}, done.stderr[-6000:]


@pytest.mark.slow
@pytest.mark.parametrize("of", ["compile", "export"])
def test_all_alone(of: str) -> None:
    alone(of, list(PIECES))


@pytest.mark.slow
def test_compiled_to_code() -> None:
    alone("inductor", list(FEW))


def test_the_page_tells_what_cannot_be() -> None:
    page = (ROOT / "scripts" / "docs" / "how-to" / "learning.md").read_text()
    for name, piece in PIECES.items():
        for of, reason in piece.cannot.items():
            assert f"| {name} | {of} | {reason} |" in page
    lacking = {of: sum(of in piece.cannot for piece in PIECES.values()) for of in (*QUICK, *SLOW, *ALONE)}
    assert max(lacking.values()) <= len(PIECES) // 10 and lacking["grad"] == 0, lacking
