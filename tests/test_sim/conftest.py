"""One tool, with the arm's reach, and one object for all simulator tests."""

import pytest

from rumi.tasks.rummage.scenes import SCENES, large_handled_mug, make_tool
from tests.fixtures.optional import tests_without

collect_ignore_glob = tests_without("mujoco", "pytorch_kinematics")


@pytest.fixture(scope="session")
def mug():
    return large_handled_mug()


@pytest.fixture(scope="session")
def arm_tool(cache):
    return make_tool(SCENES["mug-0"], cache_dir=cache)
