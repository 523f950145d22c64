"""Seeds as people write them."""

import re

from rumi.errors import UsageError


def seeds_of(text: str) -> tuple[int, ...]:
    """Seeds of "0-9" or "3,5,8-9", each once.

    Raises:
        UsageError: it is neither.
    """
    seeds: list[int] = []
    for piece in text.split(","):
        match = re.fullmatch(r"\s*(\d+)(?:-(\d+))?\s*", piece)
        if match is None or (match[2] and int(match[2]) < int(match[1])):
            raise UsageError(f"Expected seeds such as 0-9 or 0,3,5-7, got {text!r}")
        seeds += range(int(match[1]), int(match[2] or match[1]) + 1)
    return tuple(dict.fromkeys(seeds))
