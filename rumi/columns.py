"""Lines of text for a terminal of 80 columns."""

import textwrap

_WIDTH = 80


def folded(text: str, *, indent: int = 2, hang: int = 9) -> list[str]:
    """Text as lines that fit a terminal with an indent before each; words stay whole.

    Args:
        text: of one line.
        indent: columns that are put before every line afterwards.
        hang: columns that lines after the first begin with.
    """
    return textwrap.wrap(
        text, _WIDTH - indent, subsequent_indent=" " * hang, break_long_words=False, break_on_hyphens=False
    )
