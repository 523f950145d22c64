"""How long the first run on a machine takes: nothing compiled is kept yet."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from rumi.bench.case import Case, Setup, Variant, case
from rumi.exit_codes import DONE, NOT_CONVERGED

_ENDED = (DONE, NOT_CONVERGED)  # few runs are right after one action
_RUN = ("run", "mug-0", "--steps", "1", "--no-figures")


def _first_run(*, kept: bool) -> Callable[[], None]:
    """A run of one action by another process, whose compiled kernels begin empty, or are those of this one."""

    def run() -> None:
        with tempfile.TemporaryDirectory() as folder:
            kernels = {} if kept else {"NUMBA_CACHE_DIR": str(Path(folder) / "kernels")}
            command = [sys.executable, "-m", "rumi", *_RUN, "--out", str(Path(folder) / "runs")]
            ended = subprocess.run(command, check=False, capture_output=True, text=True, env={**os.environ, **kernels})
            if ended.returncode not in _ENDED:
                raise RuntimeError(f"Expected the run to end by itself, got {ended.returncode}: {ended.stderr}")

    return run


@case("cold-start", slow=True, host=True)
def cold_start(setup: Setup) -> Case:
    """A first run, kernels included, beside a later one."""
    later = "kernels kept"
    variants = (Variant(later, _first_run(kept=True)), Variant("nothing compiled", _first_run(kept=False)))
    return Case(
        "a run of mug-0, one action, in a fresh interpreter",
        variants[: setup.size(2, 1)],
        (later,),
        later,
        elsewhere=True,
        rounds=1,
        warm=False,
    )
