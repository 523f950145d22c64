"""One mug and one tool for all."""

import pytest

pytest.importorskip("mujoco")
pytest.importorskip("cv2")

from rumi.sim.bodies import body_of
from rumi.tasks.handle.settings import HandleSettings, task_of
from rumi.tasks.rummage.scenes import large_handled_mug, make_tool


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
