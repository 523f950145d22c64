"""The page on learning code: its code runs as it is printed, by itself, since it compiles."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_the_code_of_the_page() -> None:
    code = (ROOT / "scripts" / "docs" / "learning.md").read_text().split("```python\n")[1].split("```")[0]
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    shown = done.stdout.splitlines()
    assert done.returncode == 0, done.stderr
    assert shown[0].startswith("True ['raw_free_scale', 'raw_tolerance'")
    assert shown[1:] == ["torch.Size([4, 16, 3])", "torch.Size([]) tensor(2.0790)"]
