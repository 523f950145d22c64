"""Program of the viewer Rerun."""

import importlib.util
import os
import sys
from pathlib import Path


def viewer_program() -> list[str]:
    """Words that start the viewer: its binary, where it lies beside its package, else the package as a program.

    The package puts a process of Python before the binary, which takes a tenth of the time to the first picture.
    """
    spec = importlib.util.find_spec("rerun_cli")
    if spec is not None and spec.origin is not None and "RERUN_CLI_PATH" not in os.environ:
        binary = Path(spec.origin).with_name("rerun.exe" if sys.platform == "win32" else "rerun")
        if os.access(binary, os.X_OK):
            return [str(binary)]
    return [sys.executable, "-m", "rerun_cli"]
