"""What every test can ask for: device, dtype, a seeded generator, golden numbers; and shape checks for all of them.

The hints of the four packages (`Float[Tensor, "*b 3"]`) are enforced while the tests run, `*_numba` and `*_warp`
modules apart (they compile plain functions only): in each test, for a function's first calls, and then for ever fewer,
since a check takes longer than most calls. A wrong shape then fails before the function's own check sees it: a test of
that check, or of `torch.compile`, asks for the fixture `no_shape_check`.
"""

import dataclasses
import functools
import gc
import inspect
import json
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, Self

import hypothesis
import jaxtyping
import pytest
import torch
from beartype import BeartypeConf, FrozenDict, beartype

_jaxtyped = jaxtyping.jaxtyped
PACKAGES = ("kmppi", "sdf", "sensors", "rumi")
_HERE = Path(__file__).parent

# the packages are tested from the checkout, installed or not
if str(_HERE.parent) not in sys.path:
    sys.path.insert(0, str(_HERE.parent))

# rooms whose files each compile kernels of their own: begun side by side, before the runs that need all of them
_KERNELS = ("test_dynamics", "test_registration", "test_fields", "test_planning", "test_belief", "test_metrics")
# rooms of many short files, which fill what is left at the end
_SHORT = ("test_sdf", "test_sensors", "test_kmppi")

_tests_begun = 0
_CHECKED_CALLS = 3  # of each function in a test, whatever their number


def _sampled(fn: Any = None, *, typechecker: Any) -> Any:
    """`jaxtyping.jaxtyped` for a function's first calls in each test, then every one whose count is 2^k.

    The hints of a function are read at its first call, so that those of functions without any cost nothing.
    """
    if fn is None:
        return functools.partial(_sampled, typechecker=typechecker)
    if isinstance(fn, classmethod | staticmethod):
        return type(fn)(_sampled(fn.__func__, typechecker=typechecker))
    if dataclasses.is_dataclass(fn) and not hasattr(fn.__init__, "__wrapped__"):
        fn.__init__ = _sampled(fn.__init__, typechecker=typechecker)
        return fn
    if not inspect.isfunction(fn):
        return _jaxtyped(fn, typechecker=typechecker)
    checked, test, calls = None, -1, 0

    @functools.wraps(fn)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal checked, test, calls
        if jaxtyping.config.jaxtyping_disable:
            return fn(*args, **kwargs)
        if test != _tests_begun:
            test, calls = _tests_begun, 0
        calls += 1
        if calls > _CHECKED_CALLS and calls & (calls - 1):
            return fn(*args, **kwargs)
        if checked is None:
            checked = _jaxtyped(fn, typechecker=typechecker)
        return checked(*args, **kwargs)

    return call


def _enforce_hints() -> None:
    # `Self` needs a decorated class, and the import hook decorates methods one by one; an int is a fine float
    conf = BeartypeConf(is_pep484_tower=True, hint_overrides=FrozenDict({Self: Any}))
    # the hook finds its checker by name only
    checker = ModuleType("rumi_typecheck")
    checker.check = beartype(conf=conf)
    sys.modules[checker.__name__] = checker
    jaxtyping.jaxtyped = _sampled  # the name by which the hook finds it
    finder = jaxtyping.install_import_hook(PACKAGES, f"{checker.__name__}.check").hook
    wanted = finder.should_instrument
    finder.should_instrument = lambda module_name: wanted(module_name) and not module_name.endswith(("_numba", "_warp"))


# at once, not when pytest is configured: conftest files of folders below import the packages before that; worker
# processes of pytest-xdist have no command line, and know it from the environment
if "--no-shape-check" in sys.argv:
    os.environ["RUMI_NO_SHAPE_CHECK"] = "1"
if not os.environ.get("RUMI_NO_SHAPE_CHECK"):
    early = sorted(name for name in sys.modules if name.split(".")[0] in PACKAGES)
    if early:
        raise RuntimeError(f"Expected no module of the packages before their hints are enforced, got {early}")
    _enforce_hints()

hypothesis.settings.register_profile("rumi", deadline=None, derandomize=True, database=None, max_examples=50)
hypothesis.settings.load_profile("rumi")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Options of the whole suite."""
    parser.addoption("--device", default="cpu", help="device of the fixture `device`, such as cpu or cuda")
    parser.addoption("--dtype", default="float64", choices=["float32", "float64"], help="dtype of the fixture `dtype`")
    parser.addoption("--no-shape-check", action="store_true", help="do not enforce the packages' shape hints")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip what this machine cannot run, and begin with the rooms that compile."""
    lacking = {
        "gpu": None if torch.cuda.is_available() else "needs a CUDA device",
        "data": None if os.environ.get("RUMI_DATA") else "needs RUMI_DATA to name the folder of recorded data",
    }
    for item in items:
        for name, reason in lacking.items():
            if reason and item.get_closest_marker(name):
                item.add_marker(pytest.mark.skip(reason=reason))
    items.sort(key=lambda item: _turn(item.path.parent.name))  # in a room nothing changes


def pytest_collection_finish() -> None:
    """Set aside what was loaded for good: figures collect garbage, and would look through millions of objects."""
    gc.collect()
    gc.freeze()


def _turn(room: str) -> int:
    return 0 if room in _KERNELS else 2 if room in _SHORT else 1


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Count the tests, so that each checks the hints of what it calls."""
    global _tests_begun
    _tests_begun += 1


@pytest.fixture(params=["torch", "numba"])
def version(request: pytest.FixtureRequest) -> Iterator[str]:
    """The plain versions of hot operations, then the compiled ones; for a file all of whose tests are for both."""
    from sdf import backend, compiled, gpu, posed  # noqa: F401  (registers compiled versions, so that some can be forced)

    if not {"numba": compiled.available, "warp": gpu.available}.get(request.param, lambda: True)():
        pytest.skip(f"without {request.param}")
    with backend.force(request.param):
        yield request.param


@pytest.fixture(scope="session")
def device(request: pytest.FixtureRequest) -> torch.device:
    """The device asked for by --device."""
    return torch.device(request.config.getoption("--device"))


@pytest.fixture(scope="session")
def dtype(request: pytest.FixtureRequest) -> torch.dtype:
    """The dtype asked for by --dtype, float64 unless told."""
    return getattr(torch, request.config.getoption("--dtype"))


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of what takes long to work out, for all tests, in whichever process of a run."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "cache"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture
def all_in_reach(monkeypatch: pytest.MonkeyPatch, cache: Path) -> Path:
    """Folder like `cache`, where the arm reaches every place: for runs in space, whose reach takes 12 s to solve."""
    from rumi.robot import reach_table

    zeros = torch.zeros(reach_table.table_shape(reach_table.ReachSettings()), dtype=torch.float64)
    monkeypatch.setattr(reach_table, "solve_table", lambda settings: reach_table.ReachTable(zeros, zeros))
    folder = cache / "all-in-reach"
    monkeypatch.setenv("RUMI_CACHE", str(folder))  # no table of it may stand for that of the arm
    return folder


@pytest.fixture
def at_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cache: Path) -> None:
    """The test in a folder of its own, where default folders land."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RUMI_CACHE", str(cache))
    monkeypatch.delenv("RUMI_DEBUG", raising=False)


@pytest.fixture
def generator() -> torch.Generator:
    """A CPU generator with a fixed seed, fresh for each test."""
    return torch.Generator().manual_seed(0)


@pytest.fixture(scope="session")
def golden() -> Callable[[str], dict[str, Any]]:
    """`golden(id)`: the case of that id, with `inputs`, `expected` and `atol`."""
    cases = {case["id"]: case for case in json.loads((_HERE / "fixtures" / "golden.json").read_text())["cases"]}

    def case(name: str) -> dict[str, Any]:
        if name not in cases:
            raise KeyError(f"no golden case {name!r}; there are {', '.join(sorted(cases))}")
        return cases[name]

    return case


@pytest.fixture
def no_shape_check() -> Iterator[None]:
    """Leave the packages' hints unenforced during this test."""
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", before)
