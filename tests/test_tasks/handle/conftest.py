"""One mug and one tool for all."""

import pytest

from rumi.tasks.rummage.scenes import large_handled_mug, make_tool
from tests.fixtures.optional import tests_without

collect_ignore_glob = tests_without("mujoco", "cv2")
if not collect_ignore_glob:
    from rumi.sim.bodies import body_of
    from rumi.tasks.handle.settings import HandleSettings, task_of


@pytest.fixture(scope="session")
def mug():
    return large_handled_mug()


@pytest.fixture(scope="session")
def body(mug):
    return body_of(mug.exact, task_of(HandleSettings()).physics, table=mug.sdf)


@pytest.fixture(scope="session")
def tool():
    """Without the arm's reach, which takes seconds and changes no sensor."""
    return make_tool(task_of(HandleSettings()), free_flying=True)
