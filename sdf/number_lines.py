"""Numbers in lines of text, and tables of them."""

import re

import numpy as np

_DECIMAL_COMMA = re.compile(r"[-+]?\d+(,\d+)?([eE][-+]?\d+)?")


def numbers_of(lines: list[str], first: int = 1) -> list[tuple[int, list[float]]]:
    """The numbers of each line that has something, with the line's number."""
    rows = []
    for number, line in enumerate(lines, first):
        text = line.partition("#")[0]
        words = [word for word in re.split(r"[,;\s]+", text) if word]
        if words:
            if "," in text and _has_decimal_commas(text):
                raise ValueError(
                    f"line {number} seems to have decimal commas, where a comma is taken to part two numbers: "
                    f"{line.strip()[:60]!r}; write decimal points, or a blank behind each comma that parts"
                )
            try:
                rows.append((number, [float(word) for word in words]))
            except ValueError:
                raise ValueError(f"line {number} has something that is no number: {line.strip()[:60]!r}") from None
    return rows


def _has_decimal_commas(text: str) -> bool:
    """Whether commas stand within numbers that something else parts: 3 or 6 of them then."""
    words = [word for word in re.split(r"[;\s]+", text) if word]
    return len(words) in (3, 6) and all(_DECIMAL_COMMA.fullmatch(word) for word in words)


def table_of(rows: list[tuple[int, list[float]]], width: int) -> np.ndarray:
    """Rows that are all as long, as an array (K, width).

    Raises:
        ValueError: one is not.
    """
    for number, row in rows:
        if len(row) != width:
            raise ValueError(f"line {number} has {len(row)} numbers where others have {width}")
    return np.array([row for _, row in rows]).reshape(-1, width)
