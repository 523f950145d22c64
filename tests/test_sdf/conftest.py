"""Small meshes for all."""

import pytest

from tests.fixtures import meshes


@pytest.fixture(scope="session")
def shapes():
    """`shapes.box()` and others."""
    return meshes
