"""A run's folder read as a log is: what its trace holds, in a robot's place."""

import json
from pathlib import Path
from typing import Any, Self

from rumi.runs.folder import load_run
from rumi.runs.replay import digest
from sensors.log.reader import Taken


class RunLog:
    """The readings and actions of a run's folder, by the names that `sensors.log.reader.Log` has for a log's.

    Args:
        folder: of the run.

    Raises:
        UsageError: it is none, or damaged.

    Attributes:
        path: the folder.
        settings: of the run.
        texts: JSON of the object's record and of what the run was made with, by name.
        problems: what is not as it should be.
    """

    def __init__(self, folder: Path | str) -> None:
        self.path, self._run = Path(folder), load_run(folder)
        self.settings = {**self._run.settings, "task": self._run.task}
        about = self.path / "object.json"
        made = json.dumps(self._run.settings.get("made_with", {}))
        self.texts = {"made_with": made} | ({"object": about.read_text("utf-8", "replace")} if about.is_file() else {})
        self.problems = [] if self._run.ended else ["the run was not finished: what had been written is there"]
        self.streams: dict[str, Any] = {}

    def taken(self) -> list[Taken]:
        """The steps, in order, their readings of the kind that they were recorded as."""
        return [Taken(step.reading, step.control, step.truth, digest(step.belief)) for step in self._run.steps]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        pass
