"""The log beside a run's trace: what the sensors gave before it was read, as raw streams."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from rumi.errors import UsageError
from rumi.runs.files import naming
from rumi.runs.plain import plain
from sensors.log.errors import LogError

LOG = "log.h5"
"""Name of the log within a run's folder."""


class LogRecorder:
    """Writes raw streams while a run goes on; a context manager.

    Args:
        path: of the log; it must not exist.
        about: plain values by name, such as the object's record and what the run is made with.
        raw: the streams, by name: kind, frame and further attributes.

    Raises:
        UsageError: the log cannot be written.
        ModuleNotFoundError: h5py is not installed.
    """

    def __init__(
        self,
        path: Path | str,
        about: Mapping[str, Any] | None = None,
        raw: Mapping[str, tuple[str, str, Mapping[str, Any]]] | None = None,
    ) -> None:
        from sensors.log.writer import LogWriter, StreamSpec

        self._path = Path(path)
        texts = {name: json.dumps(plain(value)) for name, value in (about or {}).items()}
        try:
            self._log = LogWriter(path, [StreamSpec(name, *told) for name, told in (raw or {}).items()], about=texts)
        except LogError as error:
            raise UsageError(str(error)) from error

    def raw(self, stream: str, stamp_ns: int, values: Mapping[str, object]) -> None:
        """Append a row to a raw stream, received when it was taken."""
        with naming(self._path):
            self._log.append(stream, stamp_ns, stamp_ns, **values)

    def finish(self, result: Any) -> None:  # noqa: ANN401  (of any task)
        """Write how the run ended, and close."""
        with naming(self._path):
            self._log.finish(plain(result.as_dict()))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._log.close()
