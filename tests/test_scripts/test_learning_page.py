"""The page on learning code: its code runs as it is printed, by itself, since it compiles."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_the_code_of_the_page() -> None:
    blocks = (ROOT / "scripts" / "docs" / "how-to" / "learning.md").read_text().split("```python\n")[1:]
    code = "\n".join(block.split("```")[0] for block in blocks)
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    shown = done.stdout.splitlines()
    assert done.returncode == 0, done.stderr
    assert shown[0].startswith("True ['raw_free_scale', 'raw_tolerance'")
    assert shown[1:3] == ["torch.Size([4, 16, 3])", "torch.Size([]) tensor(2.0790)"]
    assert shown[3:5] == ["torch.Size([2, 64]) tensor(0.)", "torch.Size([2, 4, 4])"]
