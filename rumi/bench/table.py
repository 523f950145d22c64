"""Results as an aligned table, as it is read on a terminal."""

from collections.abc import Iterator
from typing import Any

from rumi.bench.measure import Result, Row
from sdf import backend

HEADER = ("variant", "median", "quartiles", "each", "quicker", "error")
_WIDTHS = (22, 8, 15, 8, 7, 7)
_RIGHT = (False, True, True, True, True, True)


def seconds(value: float) -> str:
    """A time with three digits and its unit.

    >>> [seconds(x) for x in (12.34, 0.0999996, 4.2e-5, 6.54e-9)]
    ['12.3 s', '100 ms', '42.0 us', '6.54 ns']
    """
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)):
        if value >= 0.9995 * size or unit == "ns":
            return f"{digits(value / size)} {unit}"
    raise AssertionError(value)


def digits(value: float) -> str:
    """A number with three digits, without exponent from 0.01 up.

    >>> [digits(x) for x in (1234.5, 99.96, 9.996, 0.0421)]
    ['1234', '100', '10.0', '0.042']
    """
    for limit, decimals in ((99.95, 0), (9.995, 1), (0.9995, 2)):
        if value >= limit:
            return f"{value:.{decimals}f}"
    return f"{value:.3f}"


def span(low: float, high: float) -> str:
    """Two times with one unit.

    >>> span(0.00123, 0.00234)
    '1.23 - 2.34 ms'
    """
    number, unit = seconds(high).split()
    size = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[unit]
    return f"{digits(low / size)} - {number} {unit}"


def about(machine: dict[str, Any]) -> str:
    """What it was measured on, in three lines."""
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items() if name != "rumi")
    load = machine["load"]
    busy = "" if load is None else f"; load {load} before"
    lines = [
        f"{machine['processor']}, {machine['cores']} cores, {machine['threads']} threads, {machine['device']}, "
        f"{machine['clock']} time{busy}",
        f"rumi {machine['versions'].get('rumi', '?')} at {machine['commit'] or 'no commit'}",
        f"Python {machine['python']}, {versions}",
    ]
    return "\n".join(lines) + "\n"


def heading() -> str:
    """The columns' names."""
    return _line(HEADER)


def section(result: Result) -> str:
    """One case: its title, a line a variant, and what else is to be said."""
    lines = ["", f"{result.name}: {headline(result)}"]
    lines += [_line(row) for row in cells(result)]
    lines += [f"  {note}" for note in notes(result)]
    return "\n".join(lines)


def notes(result: Result) -> Iterator[str]:
    """What a section says below its rows."""
    if not result.agree:
        yield f"DIFFER: rumi's own variants are to agree within {result.case.tolerance:g}"
    spent = {name: value for name, value in result.case.facts.items() if name.endswith(", ms")}
    for name, value in result.case.facts.items():
        if name not in spent:
            yield f"{name}: {value}"
    if spent:
        yield "one pass, least: " + ", ".join(
            f"{name.removesuffix(', ms')} {value} ms" for name, value in spent.items()
        )
    yield from result.case.remarks
    for row in result.rows:
        if row.note:
            yield f"{row.name}: {row.note}"
    ran = {each for row in result.rows if row.name.startswith("numba") for each in row.ran.items()}
    # an operation without a compiled version is made of others, which speak for themselves
    plain = sorted(op for op, version in ran if version == backend.PLAIN and "numba" in backend.versions(op))
    if plain:
        yield f"numba: the compiled version of {', '.join(plain)} does not take these tensors, plain torch ran"
    scattered = [row.name for row in result.rows if row.timing.scatters]
    if scattered:
        yield f"times scatter, as on a busy machine: {', '.join(scattered)}"
    for why in result.left_out:
        yield f"left out: {why}"


def cells(result: Result) -> Iterator[tuple[str, ...]]:
    """A row a variant, by the columns of `HEADER`."""
    for row in result.rows:
        low, high = row.timing.quartiles_s
        each = "" if result.case.items == 1 else seconds(row.timing.median_s / result.case.items)
        ratio = "1x" if row.name == result.baseline else f"{digits(result.ratio(row))}x"
        yield (row.name, seconds(row.timing.median_s), span(low, high), each, ratio, _error(row))


def headline(result: Result) -> str:
    """What was timed."""
    case = result.case
    return case.title if case.items == 1 else f"{case.title} ({case.items} {case.item}s)"


def _error(row: Row) -> str:
    if row.error is None:
        return ""
    return "0" if row.error == 0.0 else f"{row.error:.1e}"


def _line(row: tuple[str, ...]) -> str:
    padded = [
        cell.rjust(width) if right else cell.ljust(width)
        for cell, width, right in zip(row, _WIDTHS, _RIGHT, strict=True)
    ]
    return ("  " + "  ".join(padded)).rstrip()
