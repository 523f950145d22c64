"""Live view: a run in the viewer Rerun while it goes on, in a window or, without a display, in a browser."""

import contextlib
import os
import signal
import socket
import subprocess
from collections.abc import Callable
from typing import Any, Self

from rumi.environment import has_display
from rumi.records import StepRecord
from rumi.registration.pose_summary import PoseSummary
from rumi.runs.export import StepEstimate
from rumi.runs.progress import say
from rumi.viz.task_view import TaskView
from rumi.viz.viewer import ViewerRecording
from rumi.viz.viewer_layout import layout
from rumi.viz.viewer_program import viewer_program
from sdf.extras import optional

_HOST = "127.0.0.1"  # by itself the viewer would listen to the whole network
_PATIENCE_S = 5.0  # for a viewer that does not take the last steps, or does not end


class LiveView:
    """Shows each step in a viewer; an `on_step` of `rumi.loop.run`, and a context manager.

    The viewer is a process of its own. A window stays open after the run; a server, which stands in for it where there
    is no display, ends with the run. A viewer that is closed or dies does the run no harm.

    Args:
        name: of the run.
        view: of its task.
        pose_of: the pose that the steps so far know of; None where they do not.
    """

    def __init__(self, name: str, view: TaskView, pose_of: Callable[[list[Any]], PoseSummary | None]) -> None:
        self._name, self._view, self._pose_of = name, view, pose_of
        self._steps: list[Any] = []

    def __enter__(self) -> Self:
        rerun = optional("rerun", "--view")
        port, web = _free_ports()
        self._window = has_display()
        words = [*viewer_program(), "--bind", _HOST, "--port", str(port), "--hide-welcome-screen"]
        if not self._window:
            words += ["--serve-web", "--web-viewer-port", str(web)]
        self._process = subprocess.Popen(
            words, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            url = f"rerun+http://{_HOST}:{port}/proxy"
            if not self._window:
                say(f"no display: see the run in a browser here, http://{_HOST}:{web}?url={url.replace('+', '%2B')}")
            self._stream = rerun.RecordingStream("rumi", recording_id=self._name)
            self._stream.connect_grpc(url, default_blueprint=layout(self._view, following=True))
            self._recording = ViewerRecording(self._stream, self._view)
        except BaseException:  # of what is not entered nobody leaves
            self._stop()
            raise
        return self

    def __call__(self, record: Any) -> None:  # noqa: ANN401  (of the task's own kind)
        """Show a step."""
        self._steps.append(record)
        pose = self._pose_of(self._steps)
        tool = record.reading.tool_pose[-1].double() if isinstance(record, StepRecord) else None
        found = None if pose is None else StepEstimate(record.step, float(record.step), pose, tool)
        self._recording.add(record, found)

    def __exit__(self, *error: object) -> None:
        with contextlib.suppress(Exception):  # of a viewer that is gone
            self._stream.flush(timeout_sec=_PATIENCE_S)
        with contextlib.suppress(Exception):
            self._stream.disconnect()
        if not self._window:
            self._stop()

    def _stop(self) -> None:
        """End the viewer, by force where it does not end by itself."""
        for end in (signal.SIGTERM, getattr(signal, "SIGKILL", signal.SIGTERM)):
            with contextlib.suppress(OSError):  # it is gone already
                if hasattr(os, "killpg"):  # the viewer leads its group, or a process of Python that started it does
                    os.killpg(self._process.pid, end)
                else:
                    self._process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_PATIENCE_S)
                return


def _free_ports() -> tuple[int, int]:
    """Two ports that are free just now."""
    with socket.socket() as first, socket.socket() as second:
        first.bind((_HOST, 0))
        second.bind((_HOST, 0))
        return first.getsockname()[1], second.getsockname()[1]
