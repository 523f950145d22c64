"""What the packages may import, and that none of them draws from a global random generator."""

import ast
import importlib
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

grimp = pytest.importorskip("grimp", reason="comes with import-linter")

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("kmppi", "sdf", "sensors", "rumi")
# which of the packages each may import, itself included
ALLOWED = {
    "kmppi": {"kmppi"},
    "sdf": {"sdf"},
    "sensors": {"sdf", "sensors"},
    "rumi": {"kmppi", "sdf", "sensors", "rumi"},
}
HEAVY = {"mujoco", "open3d", "cv2", "matplotlib", "trimesh", "pytorch_kinematics", "numba", "triton", "gpytorch",
         "h5py", "rosbags", "warp"}  # fmt: skip

# these draw from a global generator, or seed one, whatever they are handed
ALWAYS_GLOBAL = {
    "random",
    "secrets",
    "torch.manual_seed",
    "torch.seed",
    "torch.random",
    "torch.cuda.manual_seed",
    "torch.cuda.manual_seed_all",
    "torch.distributions",
    "torch.nn.Dropout",
    "torch.nn.functional.dropout",
}
NUMPY_SEEDED = {"Generator", "BitGenerator", "SeedSequence", "PCG64", "default_rng"}
# these do so unless they are handed a generator
TORCH_DRAWS = {
    *("rand", "randn", "randint", "randperm", "normal", "bernoulli", "multinomial", "poisson"),
    *("rand_like", "randn_like", "randint_like"),
}
METHOD_DRAWS = {
    *("normal_", "uniform_", "exponential_", "random_", "cauchy_", "log_normal_", "geometric_", "bernoulli_"),
    *("bernoulli", "multinomial"),
}


def sources(package: str) -> list[Path]:
    """All Python files of a package."""
    return sorted((ROOT / package).rglob("*.py"))


def imported(source: str) -> set[str]:
    """Top-level names of all that a source imports, wherever; a relative import stays in its package."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            found.add(node.module.split(".")[0])
    return found


def aliases(tree: ast.AST) -> dict[str, str]:
    """Full name behind each imported name."""
    names = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                top = alias.name.split(".")[0]
                names[alias.asname or top] = alias.name if alias.asname else top
        elif isinstance(node, ast.ImportFrom) and not node.level:
            for alias in node.names:
                names[alias.asname or alias.name] = f"{node.module}.{alias.name}"
    return names


def full_name(node: ast.AST, names: dict[str, str]) -> str:
    """Full name of `a.b.c` where `a` is imported, else empty."""
    if isinstance(node, ast.Name):
        return names.get(node.id, "")
    if isinstance(node, ast.Attribute):
        before = full_name(node.value, names)
        return f"{before}.{node.attr}" if before else ""
    return ""


def handed(call: ast.Call, keyword: str) -> bool:
    """Whether a call hands over a keyword, and not as None."""
    return any(k.arg == keyword and not (isinstance(k.value, ast.Constant) and k.value.value is None)
               for k in call.keywords)  # fmt: skip


def wrong_use(name: str) -> str:
    """What is wrong with using an imported name at all, or nothing."""
    parts = name.split(".")
    if any(".".join(parts[:end]) in ALWAYS_GLOBAL for end in range(1, len(parts) + 1)):
        return name
    return name if parts[:2] == ["numpy", "random"] and len(parts) > 2 and parts[2] not in NUMPY_SEEDED else ""


def wrong_call(call: ast.Call, names: dict[str, str]) -> str:
    """What is wrong with a call, or nothing."""
    name = full_name(call.func, names)
    last = call.func.attr if isinstance(call.func, ast.Attribute) else name.split(".")[-1]
    draws = (name.startswith("torch.") and name.removeprefix("torch.") in TORCH_DRAWS) or (
        not name and last in METHOD_DRAWS
    )
    if draws and not handed(call, "generator"):
        return f"{last} without generator="
    if not name and last == "seed" and not call.args:
        return ".seed() gives another seed each time"
    if name == "numpy.random.default_rng" and not (call.args or handed(call, "seed")):
        return "default_rng without a seed"
    if last == "rvs" and not handed(call, "random_state"):
        return "rvs without random_state="
    if name.startswith("trimesh.") and last.startswith("sample_surface") and not handed(call, "seed"):
        return f"{last} without seed="
    return ""


def global_draws(source: str) -> list[str]:
    """Every place where a source draws from a global generator, seeds one or leaves a seed to chance."""
    tree = ast.parse(source)
    names = aliases(tree)
    found: dict[int, str] = {}
    for node in ast.walk(tree):
        wrong = ""
        if isinstance(node, ast.Call):
            wrong = wrong_call(node, names)
        elif isinstance(node, ast.Attribute | ast.Name):
            wrong = wrong_use(full_name(node, names))
        # `a.b.c` holds `a.b`: the longest name of a line says most
        if len(wrong) > len(found.get(getattr(node, "lineno", 0), "")):
            found[node.lineno] = wrong
    return [f"line {line}: {wrong}" for line, wrong in sorted(found.items())]


def newly_loaded(statement: str, watched: set[str]) -> set[str]:
    """Which of the watched packages a statement loads in a fresh interpreter that has torch and numpy already."""
    # torch may load some of them by itself, on machines with a GPU
    code = (
        f"import sys, torch, numpy, jaxtyping; sys.path.insert(0, {str(ROOT)!r}); before = set(sys.modules)\n"
        f"{statement}\n"
        "print(*{name.split('.')[0] for name in set(sys.modules) - before})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return watched & set(done.stdout.split())


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_are_this_projects(package):
    assert Path(importlib.import_module(package).__file__).parent == ROOT / package


@pytest.mark.parametrize("package", PACKAGES)
def test_direction_of_imports(package):
    files = sources(package)
    assert files
    wrong = {
        str(path.relative_to(ROOT)): names
        for path in files
        if (names := imported(path.read_text()) & set(PACKAGES) - ALLOWED[package])
    }
    assert not wrong


def circles(imports: dict[str, set[str]]) -> list[list[str]]:
    """Modules that import each other in a circle, wherever in them: components of a graph that hang together."""
    reached = {module: {module} for module in imports}
    for module, found in reached.items():
        waiting = [module]
        while waiting:
            fresh = imports[waiting.pop()] & set(imports) - found
            found |= fresh
            waiting += fresh
    together = {frozenset(other for other in reached[module] if module in reached[other]) for module in imports}
    return sorted(sorted(group) for group in together if len(group) > 1)


def test_no_modules_import_each_other_in_a_circle():
    graph = grimp.build_graph(*PACKAGES)
    imports = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    assert len(imports) > 300
    assert circles(imports) == []


def test_circles_are_seen():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b", "d"}, "d": {"outside"}}) == [["b", "c"]]


def test_kmppi_needs_torch_alone():
    """And jaxtyping, for its hints; else the standard library."""
    needed = set().union(*(imported(path.read_text()) for path in sources("kmppi")))
    assert "torch" in needed
    assert needed - set(sys.stdlib_module_names) <= {"torch", "jaxtyping", "kmppi"}


def test_imports_are_light():
    assert newly_loaded(f"import {', '.join(PACKAGES)}", HEAVY) == set()


def test_loading_is_seen():
    assert newly_loaded("import wave, json.tool", {"wave", "sunau"}) == {"wave"}


@pytest.mark.parametrize("package", PACKAGES)
def test_nothing_draws_from_a_global_generator(package):
    wrong = {
        str(path.relative_to(ROOT)): found for path in sources(package) if (found := global_draws(path.read_text()))
    }
    assert not wrong


@pytest.mark.parametrize(
    "line",
    [
        "torch.manual_seed(0)",
        "t.rand(3)",
        "torch.randn(3, generator=None)",
        "torch.randn_like(x)",
        "torch.multinomial(w, 3, True)",
        "x.normal_()",
        "(x + 1).uniform_(0, 1)",
        "w.multinomial(3)",
        "randperm(4)",
        "torch.distributions.Normal(0, 1)",
        "Normal(0, 1)",
        "F.dropout(x)",
        "np.random.rand(3)",
        "np.random.seed(0)",
        "shuffled(x)",
        "np.random.default_rng()",
        "random.random()",
        "g.seed()",
        "stats.norm.rvs(3)",
        "trimesh.sample.sample_surface(mesh, 10)",
    ],
)
def test_global_draws_are_seen(line):
    head = (
        "import random, torch, trimesh, torch as t, numpy as np, torch.nn.functional as F\nfrom scipy import stats\n"
        "from torch import randperm\nfrom torch.distributions import Normal\n"
        "from numpy.random import permutation as shuffled\n"
    )
    assert len(global_draws(head)) == 0
    assert len(global_draws(f"{head}def f(x, w, g, mesh):\n    return {line}\n")) == 1


@pytest.mark.parametrize(
    "line",
    [
        "torch.rand(3, generator=g)",
        "torch.bernoulli(x, generator=g)",
        "x.normal_(generator=g)",
        "torch.Generator().manual_seed(3)",
        "np.random.default_rng(3).random(4)",
        "np.random.default_rng(seed=g)",
        "x.random",
        "x.normal(3)",
        "trimesh.sample.sample_surface(mesh, 10, seed=3)",
    ],
)
def test_seeded_draws_are_allowed(line):
    assert global_draws(f"import torch, trimesh, numpy as np\ndef f(x, g, mesh):\n    return {line}\n") == []


def test_shape_hints_are_enforced(request):
    """Also where all tests run, and folders' own conftest files have imported the packages first."""
    if request.config.getoption("--no-shape-check"):
        pytest.skip("asked for")
    se3 = importlib.import_module("sdf.se3")
    with pytest.raises(Exception, match="Type-check"):
        se3.from_planar("no tensor")


def asked_for(case: str, source: str) -> bool:
    """Whether a test file names a golden case, whole or as the beginning of an f-string and what it ends in."""
    begins = re.findall(r'golden\(f"([^"{]*)\{\w+\}"\)', source)
    return f'"{case}"' in source or any(
        case.startswith(begin) and f'"{case.removeprefix(begin)}"' in source for begin in begins
    )


def test_every_golden_case_is_asked_for():
    cases = json.loads((ROOT / "tests" / "fixtures" / "golden.json").read_text(encoding="utf-8"))["cases"]
    files = [path.read_text(encoding="utf-8") for path in sources("tests")]
    assert [case["id"] for case in cases if not any(asked_for(case["id"], source) for source in files)] == []


def test_golden_cases_put_together_are_seen():
    source = 'parametrize("end", ["x", "y"])\ndef test(golden, end):\n    golden(f"a.{end}"), golden("b")\n'
    assert [asked_for(case, source) for case in ("a.x", "a.y", "b", "a.z", "c")] == [True] * 3 + [False] * 2
