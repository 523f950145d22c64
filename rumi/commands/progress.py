"""What a person sees of a run while it goes on: a bar on a terminal, plain lines elsewhere."""

import math
import sys
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Protocol, Self, runtime_checkable

from tqdm import tqdm

from rumi.records import StepRecord

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


class Progress:
    """Shows each step: nll, apc, effective sample size and seconds by stage; use as a context manager.

    Args:
        label: what runs.
        steps: actions at most.
        stream: where to; a bar if it is a terminal.
    """

    def __init__(self, label: str, steps: int, stream: Stream | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._spent: dict[str, float] = {}
        self._bar = None
        if self._stream.isatty():
            self._bar = tqdm(
                total=steps,
                desc=label,
                file=self._stream,
                dynamic_ncols=True,
                leave=True,
                bar_format="{desc} {bar} {n_fmt}/{total_fmt} [{elapsed}] {postfix}",
            )
            self._bar.set_postfix_str("first view")

    def __call__(self, step: StepRecord) -> None:
        """Show a step."""
        for stage, seconds in step.timings_s.items():
            self._spent[stage] = self._spent.get(stage, 0.0) + seconds
        if self._bar is None:
            self._stream.write(line(step) + "\n")
            self._stream.flush()
            return
        self._bar.set_postfix_str(f"{numbers(step)}  {stages(self._spent, per=max(1, step.step))}", refresh=False)
        self._bar.update(step.step - self._bar.n)
        self._bar.refresh()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.close()


def both(*observers: Callable[[StepRecord], None]) -> Callable[[StepRecord], None]:
    """One `on_step` of several, called in order."""

    def on_step(step: StepRecord) -> None:
        for observer in observers:
            observer(step)

    return on_step


def numbers(step: StepRecord) -> str:
    """The numbers of a step that tell how it goes."""
    known = "" if step.nll is None else f"nll {step.nll:.1f}  "
    apc = "-" if math.isnan(step.apc) else f"{1e3 * step.apc:.1f} mm"
    return f"{known}expects {step.expected_nll:.1f}  apc {apc}  ess {step.ess:.0f}"


def stages(seconds: Mapping[str, float], per: int = 1) -> str:
    """Seconds by stage, known stages first."""
    ordered = sorted(seconds, key=lambda stage: _STAGES.index(stage) if stage in _STAGES else len(_STAGES))
    return " ".join(f"{stage} {seconds[stage] / per:.2f}s" for stage in ordered)


def line(step: StepRecord) -> str:
    """A step as one line of text."""
    at = "first view" if step.control is None else f"action {step.step}"
    marks = [
        word
        for word, holds in (
            ("contact", step.control is not None and bool(step.reading.in_contact.any())),
            ("resampled", step.resampled),
            ("sure", step.converged),
        )
        if holds
    ]
    said = f"  [{', '.join(marks)}]" if marks else ""
    return f"{at}: {numbers(step)}  {stages(step.timings_s)}{said}"
