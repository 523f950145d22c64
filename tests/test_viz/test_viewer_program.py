"""The viewer's program: its binary where there is one, without a process of Python before it."""

import sys
from types import SimpleNamespace

import pytest

from rumi.viz import viewer_program as module

PACKAGE = [sys.executable, "-m", "rerun_cli"]


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package of the viewer, whose binary it gives."""
    monkeypatch.delenv("RERUN_CLI_PATH", raising=False)
    monkeypatch.setattr(module.sys, "platform", "linux")
    spec = SimpleNamespace(origin=str(tmp_path / "__init__.py"))
    monkeypatch.setattr(module.importlib.util, "find_spec", lambda name: spec if name == "rerun_cli" else None)
    return tmp_path / "rerun"


def test_the_binary_is_started_by_itself(package):
    assert module.viewer_program() == PACKAGE
    package.write_text("")
    package.chmod(0o755)
    assert module.viewer_program() == [str(package)]


def test_a_binary_that_is_asked_for_is_left_to_the_package(package, monkeypatch):
    package.write_text("")
    package.chmod(0o755)
    monkeypatch.setenv("RERUN_CLI_PATH", "/opt/rerun")
    assert module.viewer_program() == PACKAGE
