"""Optional packages, each brought by an extra of the project: what is missing is named with what installs it."""

from importlib import import_module, metadata
from pathlib import Path
from typing import Any

EXTRAS = {
    "sim": "mujoco",
    "robot": "pytorch_kinematics",
    "plot": "matplotlib mpl_toolkits PIL contourpy",
    "mesh": "trimesh scipy networkx coacd",
    "cluster": "submitit",
    "vision": "cv2",
    "logs": "h5py rosbags lz4 backports",
    "serve": "msgspec",
    "view": "rerun",
    "baselines": "gpytorch",
    "gym": "gymnasium",
    "gpu": "warp",
    "peers": "pytorch_volumetric chsel pytorch_mppi",
    "stress": "mpmath hypothesis",
}
"""Packages that may be missing, by the extra that brings them."""

_ROOT = Path(__file__).resolve().parents[1]


def optional(name: str, what: str = "This") -> Any:  # noqa: ANN401  (a module, mostly without types)
    """A package of an extra, imported.

    Args:
        name: of the package or of a module in it, such as "cv2".
        what: needs it, such as "Reading a mesh".

    Raises:
        ModuleNotFoundError: it is not installed, or not whole; the message says what installs it.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise ModuleNotFoundError(f"{what} needs {name} ({error}): {remedy(name)}", name=name) from error


def remedy(name: str, root: Path = _ROOT) -> str:
    """The command that installs an optional package; "" for one that no extra brings.

    Of a checkout it names the checkout's extra; else the packages themselves: an index may hold another project of the
    name.

    Args:
        name: of the package, of a module in it or of the extra.
        root: of the checkout, if there is one.
    """
    package = name.partition(".")[0]
    extra = next((extra for extra, packages in EXTRAS.items() if package in (extra, *packages.split())), None)
    if extra is None:
        return ""
    if (root / "pyproject.toml").is_file():
        return f"pip install -e '{'.' if root == Path.cwd() else root}[{extra}]'"
    try:
        listed = [one.partition(";") for one in metadata.requires("rumi") or ()]
    except metadata.PackageNotFoundError:
        listed = []
    wanted = [f"'{package.strip()}'" for package, _, marker in listed if f'extra == "{extra}"' in marker]
    return "pip install " + " ".join(wanted or EXTRAS[extra].split())
