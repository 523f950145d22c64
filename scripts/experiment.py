"""One driver of all experiments: measure each variant by each seed once, keep a line of each, print a table of them."""

import itertools
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field, make_dataclass
from multiprocessing import get_context
from pathlib import Path
from types import GenericAlias
from typing import Annotated, Any

import torch
import tyro

from rumi.errors import UsageError
from scripts.reproduce.seeds import seeds_of
from scripts.store import Figures, Line, Store

RESULTS = Path(__file__).resolve().parent / "results"
FIGURES = Path(__file__).resolve().parent / "docs" / "figures"
Variant = dict[str, Any]


@dataclass(frozen=True)
class Experiment:
    """Work by variant and seed, and the table of its results.

    Attributes:
        description: help of the command line.
        results: file of the results in scripts/results.
        axes: what varies beside the seed, by the field of a line that says it; an option of the command line each.
        measure: figures of one variant, given by the axes, the parameters and the seed.
        table: Markdown of some lines, given what the command line has chosen of the axes.
        seeds: by default; empty where the seed is no part of a variant.
        usual: what is run by default of an axis, where that is not all of it.
        parameters: further options of `run` that belong to the variant, with their defaults.
        identity: what else tells a line of a variant from others, such as a hash of settings or of code.
        possible: whether there is such a variant.
        commands: further commands by name: class of their options, and what they do.
    """

    description: str | None
    results: str
    axes: Mapping[str, Sequence[Any]]
    measure: Callable[..., Figures]
    table: Callable[[list[Line], Mapping[str, tuple[Any, ...]]], str]
    seeds: str = ""
    usual: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    parameters: Mapping[str, Any] = field(default_factory=dict)
    identity: Callable[[Variant], Mapping[str, Any]] = lambda variant: {}
    possible: Callable[[Variant], bool] = lambda variant: True
    commands: Mapping[str, tuple[type, Callable[[Any], None]]] = field(default_factory=dict)

    def main(self, arguments: Sequence[str] | None = None) -> None:
        """Run what is missing and show it, only show it, or carry out another command."""
        own = {"run": self._options("run"), "show": self._options("show")}
        kinds: dict[str, Callable[..., Any]] = {**own, **{name: kind for name, (kind, _) in self.commands.items()}}
        options = tyro.extras.subcommand_cli_from_dict(kinds, description=self.description, args=arguments)
        for name, (kind, command) in self.commands.items():
            if type(options) is kind and name not in own:
                command(options)
                return
        seeds = None if options.__dict__.get("seeds") is None else seeds_of(options.seeds)
        chosen = {name: getattr(options, _flag(name)) for name in self.axes}
        chosen = {name: values for name, values in chosen.items() if values}
        for name, value in ((name, value) for name, values in chosen.items() for value in values):
            if value not in self.axes[name]:
                raise UsageError(f"There is no {name} {value!r}; there are {', '.join(map(str, self.axes[name]))}")
        if isinstance(options, own["run"]):
            self.run(options, seeds, chosen)
        sys.stdout.write(self.show(options.results, seeds, chosen))

    def run(self, options: Any, seeds: Sequence[int] | None, chosen: Mapping[str, Sequence[Any]]) -> None:  # noqa: ANN401  (a class made here)
        """Measure what the file lacks, seed by seed."""
        torch.set_num_threads(options.threads)
        more = {name: getattr(options, name) for name in self.parameters}
        end, store = time.monotonic() + options.seconds, Store(options.results)
        missing = [
            (variant, self.settings(variant))
            for variant in self.variants(seeds, chosen, more)
            if not store.has(self.settings(variant))
        ]
        for settings, figures in self._measured(missing, options.jobs, end):
            store.add(settings, figures)
            sys.stderr.write(", ".join(f"{name} {settings[name]}" for name in (*self.axes, "seed") if name in settings))
            sys.stderr.write("\n")

    def variants(
        self, seeds: Sequence[int] | None, chosen: Mapping[str, Sequence[Any]], more: Mapping[str, Any]
    ) -> Iterator[Variant]:
        """All work that is asked for."""
        axes = [chosen.get(name) or self.usual.get(name) or values for name, values in self.axes.items()]
        for seed in [None] if not self.seeds else seeds_of(self.seeds) if seeds is None else seeds:
            for values in itertools.product(*axes):
                variant = dict(zip(self.axes, values, strict=True)) | dict(more)
                variant |= {} if seed is None else {"seed": seed}
                if self.possible(variant):
                    yield variant

    def settings(self, variant: Variant) -> Line:
        """All that tells a line of a variant from others."""
        return {**variant, **self.identity(variant)}

    def show(self, path: Path, seeds: Sequence[int] | None = None, chosen: Mapping[str, Any] | None = None) -> str:
        """The table of a file."""
        chosen = chosen or {}
        lines = [
            line
            for line in Store(path).flat()
            if (seeds is None or line.get("seed") in seeds)
            and all(line.get(name) in values for name, values in chosen.items())
        ]
        return self.table(lines, chosen).rstrip("\n") + "\n"

    def _measured(
        self, missing: Sequence[tuple[Variant, Line]], jobs: int, end: float
    ) -> Iterator[tuple[Line, Figures]]:
        """Settings and figures as they come, begun before the end."""
        if jobs == 1:
            for variant, settings in missing:
                if time.monotonic() > end:
                    return
                yield settings, self.measure(**variant)
            return
        os.environ["OMP_NUM_THREADS"] = "1"  # read by a process when it loads torch
        with ProcessPoolExecutor(jobs, get_context("spawn"), torch.set_num_threads, (1,)) as pool:
            begun = {pool.submit(_unless_late, self.measure, variant, end): own for variant, own in missing}
            for done in as_completed(begun):
                if (figures := done.result()) is not None:
                    yield begun[done], figures

    def _options(self, name: str) -> type:
        """Class of the options of `run` or `show`."""
        fields: list[tuple[str, Any, Any]] = []

        def option(name: str, kind: Any, default: Any, text: str) -> None:  # noqa: ANN401
            fields.append((name, Annotated[kind, tyro.conf.arg(help=text)], default))

        for axis, values in self.axes.items():
            kind: Any = GenericAlias(tuple, (type(values[0]), ...))
            option(_flag(axis), kind, (), f"which; by default {self.usual.get(axis, values)}")
        if self.seeds:
            option("seeds", str | None, None, f"such as 0-9 or 3,5; {self.seeds} to run; tuning starts from 1000")
        option("results", Path, RESULTS / self.results, "file of the results, one JSON line each")
        if name == "run":
            for parameter, default in self.parameters.items():
                option(parameter, tuple[str, ...] if default == () else type(default), default, "of each run")
            option("seconds", float, float("inf"), "begin nothing after so long; give the command again to go on")
            if "threads" not in self.parameters:
                option("threads", int, 1, "of PyTorch and of the kernels")
            option("jobs", int, 1, "processes at once, each with one thread")
        made = make_dataclass(name.capitalize(), fields, frozen=True)
        made.__doc__ = {"run": "Measure what is missing, and print the table.", "show": "Print the table."}[name]
        return made


def newest(lines: Sequence[Line]) -> list[Line]:
    """Those by the code of the last."""
    return [line for line in lines if line["code"] == lines[-1]["code"]]


def _unless_late(measure: Callable[..., Figures], variant: Variant, end: float) -> Figures | None:
    return None if time.monotonic() > end else measure(**variant)


def _flag(axis: str) -> str:
    return axis if axis.endswith(("s", "_mm")) else axis + "s"
