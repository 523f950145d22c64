"""How long the package takes to load."""

import subprocess
import sys
from collections.abc import Callable

from rumi.bench.case import Case, Setup, Variant, case

_TORCH, _ALONE = "import torch, numpy", "torch and numpy"


def _fresh(statement: str) -> Callable[[], None]:
    def run() -> None:
        subprocess.run([sys.executable, "-c", statement], check=True, capture_output=True)

    return run


@case("import", host=True)
def load(setup: Setup) -> Case:
    """Loading the package in a fresh interpreter."""
    return Case(
        "loading in a fresh interpreter",
        (Variant("rumi", _fresh(f"{_TORCH}, rumi")), Variant(_ALONE, _fresh(_TORCH), "naive")),
        (_ALONE,),
        _ALONE,
        elsewhere=True,
    )
