"""The log beside a run's trace: what the belief took in, step by step, so that the run can be had again."""

import json
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import torch

from rumi.errors import UsageError
from rumi.records import RunResult, StepRecord
from rumi.runs.plain import plain
from rumi.runs.replay import digest
from sensors.log.errors import LogError
from sensors.reading import Reading

LOG = "log.h5"
"""Name of the log within a run's folder."""


class LogRecorder:
    """Writes a log while a run goes on; usable as `on_step` of `rumi.loop.run` and as a context manager.

    Args:
        path: of the log; it must not exist.
        settings: everything that the run was asked for, as plain values or dataclasses.
        about: further plain values by name, such as the object's record and what the run is made with.
        dtype: of the readings' floating numbers.
        raw: streams that are known from the start, by name: kind, frame and further attributes.
        readings: their kind.

    Raises:
        UsageError: the log cannot be written.
        ModuleNotFoundError: h5py is not installed.
    """

    def __init__(
        self,
        path: Path | str,
        settings: Mapping[str, Any],
        about: Mapping[str, Any] | None = None,
        *,
        dtype: torch.dtype = torch.float32,
        raw: Mapping[str, tuple[str, str, Mapping[str, Any]]] | None = None,
        readings: type[Reading] = Reading,
    ) -> None:
        from sensors.log.writer import LogWriter, StreamSpec

        texts = {name: json.dumps(plain(value)) for name, value in (about or {}).items()}
        float_type = "f8" if dtype == torch.float64 else "f4"
        try:
            streams = [StreamSpec(name, *told) for name, told in (raw or {}).items()]
            self._log = LogWriter(
                path, streams, settings=plain(settings), about=texts, float_type=float_type, readings=readings
            )
        except LogError as error:
            raise UsageError(str(error)) from error

    def __call__(self, step: StepRecord) -> None:
        """Append a step; once this returns, a kill no longer loses it."""
        self._log.reading(step.reading, control=step.control, truth=step.truth, digest=digest(step.belief))

    def raw(self, stream: str, stamp_ns: int, values: Mapping[str, object]) -> None:
        """Append a row to a raw stream, received when it was taken."""
        self._log.append(stream, stamp_ns, stamp_ns, **values)

    def finish(self, result: RunResult) -> None:
        """Write how the run ended, and close."""
        self._log.finish(plain(result.as_dict()))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._log.close()
