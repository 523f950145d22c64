"""The public names of the packages: each can be had, says what it is, and its arguments are described."""

import inspect
import re
from pathlib import Path

import pytest

import kmppi
import sdf
import sensors

PACKAGES = {"kmppi": kmppi, "sdf": sdf, "sensors": sensors}
NAMES = [(package, name) for package, module in PACKAGES.items() for name in module.__all__]


@pytest.mark.parametrize(("package", "name"), NAMES)
def test_it_says_what_it_is(package, name):
    found = getattr(PACKAGES[package], name)
    if not (inspect.isclass(found) or inspect.isfunction(found) or inspect.ismodule(found)):
        return  # a table or a type
    assert inspect.getdoc(found)
    if package == "kmppi" or not inspect.isfunction(found):
        return
    arguments = re.findall(r"^    (\w+)(?:, \w+)*:", inspect.getdoc(found), re.MULTILINE)
    assert set(inspect.signature(found).parameters) <= set(arguments), "each argument is described"


@pytest.mark.parametrize("package", ["sdf", "sensors"])
def test_it_lists_what_it_has(package):
    root = Path(__file__).resolve().parents[2]
    assert Path(PACKAGES[package].__file__).resolve() == root / package / "__init__.py", "and no other distribution's"
    with pytest.raises(AttributeError, match="has no attribute 'nothing'; it has "):
        _ = PACKAGES[package].nothing
