"""What a person sees of a run while it goes on: a bar on a terminal, plain lines elsewhere."""

import math
import sys
from collections.abc import Callable, Mapping
from typing import Any, Protocol, Self, runtime_checkable

from tqdm import tqdm

from rumi.columns import folded

_STAGES = ("simulate", "belief", "plan", "agree", "score")


@runtime_checkable
class Stream(Protocol):
    """What text can be shown on."""

    def write(self, text: str, /) -> int:
        """Show a text."""
        ...

    def flush(self) -> None:
        """Show it now."""
        ...

    def isatty(self) -> bool:
        """Whether it is a terminal."""
        ...


def say(text: str) -> None:
    """A line for people, beside what a command gives."""
    sys.stderr.write(f"rumi: {text}\n")
    sys.stderr.flush()


def announce(agent: object) -> None:
    """Say what a run relies on, and what is not measured and may make its belief sure and wrong."""
    if relies_on := getattr(agent, "relies_on", ""):
        say("\n".join(folded(f"relies on {relies_on}", indent=6, hang=6)))
    for warning in getattr(agent, "warnings", ()):
        say("\n".join(folded(f"warning: {warning}", indent=6, hang=6)))


class Progress:
    """Shows each step and its seconds, within 80 columns; an `on_step` of `rumi.loop.run`, and a context manager.

    Args:
        label: what runs.
        steps: actions at most; None where nobody knows.
        describe: a step's record in few words and numbers.
        stream: where to; a bar if it is a terminal.
    """

    def __init__(
        self, label: str, steps: int | None, describe: Callable[[Any], str], stream: Stream | None = None
    ) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._describe = describe
        self._bar, named = None, label.replace("{", "{{").replace("}", "}}")
        if self._stream.isatty():
            self._bar = tqdm(
                total=steps,
                desc="first view",
                file=self._stream,
                dynamic_ncols=True,
                leave=True,
                bar_format=named + " {bar:4} {n_fmt}/{total_fmt} [{elapsed}] {desc}",
            )

    def __call__(self, record: Any) -> None:  # noqa: ANN401  (a record of any task: `step` and `timings_s`)
        """Show a step."""
        if self._bar is None:
            at = f"action {record.step}" if record.step else "first view"
            self._stream.write(f"{at}: {self._describe(record)}  {math.fsum(record.timings_s.values()):.1f} s\n")
            self._stream.flush()
            return
        self._bar.set_description_str(self._describe(record), refresh=False)
        self._bar.update(record.step - self._bar.n)
        self._bar.refresh()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.close()


def both(*observers: Callable[[Any], None]) -> Callable[[Any], None]:
    """One `on_step` of several, called in order."""

    def on_step(record: Any) -> None:  # noqa: ANN401
        for observer in observers:
            observer(record)

    return on_step


def stages(seconds: Mapping[str, float]) -> str:
    """Seconds by stage, known stages first."""
    ordered = sorted(seconds, key=lambda stage: _STAGES.index(stage) if stage in _STAGES else len(_STAGES))
    return " ".join(f"{stage} {seconds[stage]:.2f}s" for stage in ordered)
