"""Dataset of recorded runs and logs, for a DataLoader."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils.data import Dataset

from rumi.errors import UsageError
from rumi.runs.logbook import LOG
from rumi.runs.recorded import RunLog
from sdf.containers import Ragged, collate, container, index, pad, stack
from sdf.extras import optional
from sensors.contact_reading import ContactReading
from sensors.log.errors import LogError
from sensors.log.reader import Log, Taken
from sensors.reading import Reading


@container({"valid": Ragged(-1)})
@dataclass(frozen=True)
class Episode:
    """Run of T steps, the first reading's among them; a batch of runs has its axes in front.

    Attributes:
        reading: of all steps, (*b, T): its tensors have that axis first, padded to the most points and instants.
        control: (*b, T, A), the action that led to each step; 0 at the first.
        truth: (*b, T, 4, 4), true world_T_object; None where it is not known of all steps.
        valid: (*b, T), False for steps that pad a batch, which repeat the last one.
    """

    reading: Reading
    control: Float[Tensor, "*b T A"]
    truth: Float[Tensor, "*b T 4 4"] | None
    valid: Bool[Tensor, "*b T"]

    @classmethod
    def of(cls, steps: Sequence[Taken]) -> "Episode":
        """Of the steps of a recording, the first reading first.

        Raises:
            UsageError: there are none, or their readings are no `Reading`s of a robot that pushes things about.
        """
        readings = [step.reading for step in steps]
        if not readings or not all(isinstance(reading, Reading) for reading in readings):
            kinds = sorted({type(reading).__name__ for reading in readings}) or ["none"]
            raise UsageError(f"Expected a recording with readings of a rummaging task, got {', '.join(kinds)}")
        if any(isinstance(reading, ContactReading) for reading in readings):
            readings = [ContactReading.of(reading) for reading in readings]
        still = next((step.control for step in steps if step.control is not None), readings[0].configuration)
        control = [torch.zeros_like(still) if step.control is None else step.control for step in steps]
        truths = [step.truth for step in steps if step.truth is not None]
        truth = torch.stack(truths) if len(truths) == len(steps) else None
        return cls(collate(readings), torch.stack(control), truth, torch.ones(len(steps), dtype=torch.bool))

    def __len__(self) -> int:
        """Number of steps, padding included."""
        return self.valid.shape[-1]


def collate_episodes(episodes: Sequence[Episode]) -> Episode:
    """A batch of single runs, padded: the `collate_fn` of a DataLoader over `RecordedRuns`."""
    longest = max(len(episode) for episode in episodes)
    even = []
    for episode in episodes:
        at = torch.arange(longest).clamp_max(len(episode) - 1)
        longer = index(episode, at)
        even.append(Episode(longer.reading, longer.control, longer.truth, torch.arange(longest) < len(episode)))
    return stack(pad(even))


class RecordedRuns(Dataset[Episode]):
    """Recorded runs and logs as a map-style dataset; an item is the `Episode` of one of them.

    It holds paths alone and opens a recording where it is asked for, so that workers of a DataLoader need no more; what
    a run's folder or a log holds is what `rumi replay` reads.

    Args:
        paths: of runs' folders and logs (.h5).

    Raises:
        UsageError: one is not there.
    """

    def __init__(self, paths: Sequence[Path | str]) -> None:
        self.paths = [Path(path) for path in paths]
        for path in self.paths:
            if not path.exists():
                raise UsageError(f"Expected the folder of a run or a log, got {path}, which is not there")

    def __len__(self) -> int:
        """Number of recordings."""
        return len(self.paths)

    def __getitem__(self, at: int) -> Episode:
        """The recording of a number.

        Raises:
            UsageError: it is damaged, or of a task whose readings are others.
        """
        path = self.paths[at]
        if path.is_dir() and (path / "trace.npz").is_file():
            return Episode.of(RunLog(path).taken())
        optional("h5py", "A log")
        try:
            with Log(path / LOG if path.is_dir() else path) as log:
                return Episode.of(log.taken())
        except LogError as error:
            raise UsageError(str(error)) from error
