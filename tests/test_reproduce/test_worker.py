"""Claims of work, which end with their process."""

import subprocess
import sys
from pathlib import Path

import pytest

from scripts.reproduce.worker import Claims

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.skipif(sys.platform == "win32", reason="locks of files are POSIX's")
def test_a_claim_ends_with_its_process(tmp_path):
    code = (
        "import sys; from pathlib import Path; from scripts.reproduce.worker import Claims\n"
        "claims = Claims(Path(sys.argv[1])); print(claims.take('00ab' * 4), claims.take('ffff' * 4), flush=True)\n"
        "sys.stdin.readline(); claims.leave('ffff' * 4); print('left', flush=True); sys.stdin.readline()"
    )
    path = tmp_path / "claims"
    other = subprocess.Popen(
        [sys.executable, "-c", code, str(path)], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert other.stdout.readline().split() == ["True", "True"]
        own = Claims(path)
        assert not own.take("00ab" * 4)
        assert own.take("0000" * 4)
        assert not own.take("ffff" * 4)
        other.stdin.write("\n")
        other.stdin.flush()
        assert other.stdout.readline() == "left\n"
        assert own.take("ffff" * 4)
        assert not own.take("00ab" * 4)
    finally:
        other.kill()
        other.wait()
    assert own.take("00ab" * 4)
