"""The viewer's page in a browser without a display, where Chromium and the viewer are installed."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from rumi.cli import main
from rumi.runs.folder import RunRecorder
from rumi.viz import style
from rumi.viz.live import _free_ports
from rumi.viz.primitives import rgb
from tests.fixtures.browser import CHROMIUM, Browser
from tests.fixtures.made_up_run import make_up

pytest.importorskip("rerun")
pytest.importorskip("PIL")

DRAWN = (style.NLL, style.SURFACE, style.TOOL)
"""Colours of the object, of points seen on it and of the tool."""
PATIENCE_S = 240.0  # a machine may be slow and busy: only a failing test waits so long

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")]


@pytest.fixture
def address(tmp_path):
    """Of the page that shows a made-up run."""
    made = make_up(5, particles=10)
    with RunRecorder(tmp_path / "run", {"task": "mug-0", "seed": 3}, made.geometry) as recorder:
        for step in made.steps:
            recorder(step)
    assert main(["view", str(tmp_path / "run"), "--headless"]) == 0
    port, web = _free_ports()
    words = ["--bind", "127.0.0.1", "--port", str(port), "--serve-web", "--web-viewer-port", str(web)]
    server = subprocess.Popen(
        [sys.executable, "-m", "rerun_cli", *words, str(tmp_path / "run/run.rrd")],
        start_new_session=True,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        next(line for line in server.stderr if "Hosting a web-viewer" in line)
        yield f"http://127.0.0.1:{web}?url=rerun%2Bhttp://127.0.0.1:{port}/proxy"
    finally:
        os.killpg(server.pid, signal.SIGKILL)
        server.communicate()


def test_the_page_draws_the_object_and_what_was_sensed(address, tmp_path):
    begun, lacking = time.monotonic(), DRAWN
    with Browser(address, tmp_path / "profile") as browser:
        while lacking and time.monotonic() < begun + PATIENCE_S:
            time.sleep(1.0)
            seen = browser.picture()
            scene = seen[50:, : seen.shape[1] // 2]
            lacking = [colour for colour in DRAWN if (np.abs(scene - rgb(colour)).max(-1) < 40).sum() < 20]
    assert not lacking
