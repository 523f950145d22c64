"""The paper's figures as they are printed: its sums are those of its rows, but for one misprint."""

import pytest

from scripts.reproduce import paper

TOTALS = {
    "successes": {"mug": (28, 14, 25, 9, 0), "drill": (26, 25, 19, 1, 16), "box": (25, 24, 22, 9, 11)},
    "cumulative_nll": {
        "mug": (3385, 4444, 4386, 5182, 7555),
        "drill": (46204, 46790, 64499, 78979, 83739),
        "box": (44776, 44898, 60568, 65655, 44285),
    },
}
"""The totals as they are printed, by object, in the order of `paper.METHODS`."""


@pytest.mark.parametrize(
    ("name", "figures"), [("successes", paper.SUCCESSES), ("cumulative_nll", paper.CUMULATIVE_NLL)]
)
def test_rows_add_up(name, figures):
    for family, printed in TOTALS[name].items():
        for (method, own), total in zip(figures.items(), printed, strict=True):
            added = sum(own[task] for task in paper.FAMILIES[family])
            if (name, family, method) == ("cumulative_nll", "mug", "info-only"):
                assert (added, total) == (3872, 4444)
            else:
                assert added == total, (family, method)


def test_mean_correlation_is_the_one_of_the_text():
    flat = [paper.CORRELATION[task] for name in ("mug", "drill") for task in paper.FAMILIES[name]]
    assert round(sum(flat) / len(flat), 2) == 0.87
