"""Files of points and polygons in the Object File Format (OFF)."""

from sdf.number_lines import numbers_of

_Rows = list[tuple[int, list[float]]]


def read_off(text: str) -> tuple[_Rows, _Rows]:
    """Points and polygons of an OFF file, the numbers of each with its line's number.

    Comments may stand anywhere, and the header may have numbers of any kind.

    Raises:
        ValueError: with what was expected; there are fewer points than the header says, or more that are no polygons.
    """
    lines = text.splitlines()
    for place, line in enumerate(lines):
        words = line.partition("#")[0].split()
        if not words:
            continue
        if not words[0].upper().endswith("OFF"):
            raise ValueError(f"expected OFF in its first line, got {line.strip()[:40]!r}")
        lines[place] = " ".join(words[1:])
        break
    rows = numbers_of(lines)
    if not rows:
        raise ValueError("expected the number of points after OFF, got nothing")
    said, *others = rows[0][1]
    if not (said >= 0 and said.is_integer()):
        raise ValueError(f"expected the number of points after OFF, got {said:g}")
    count, polygons, rest = int(said), max([0.0, *others[:1]]), rows[1:]
    if len(rest) < count or (len(rest) > count and polygons == 0):
        raise ValueError(f"expected the {count} points that its header says, got {len(rest)}")
    return rest[:count], rest[count:][: int(min(polygons, len(rest)))]
