"""What the paper reports (RUMI, arXiv 2408.10450): Tables II, III, V, VI and VII, in its order of rows and columns."""

METHODS = {
    "rumi": "Ours",
    "info-only": "InfoOnly",
    "reach-only": "ReachOnly",
    "gpvr": "GPVR",
    "slide": "Slide",
}
"""The paper's names of the methods, by ours."""

_TASKS = (
    *("mug-0", "mug-1", "mug-2", "drill-0", "drill-1", "drill-2", "box-0", "box-1", "box-2"),
    *("shelf-mug", "shelf-box"),
)

FAMILIES = {
    "mug": ("mug-0", "mug-1", "mug-2"),
    "drill": ("drill-0", "drill-1", "drill-2"),
    "box": ("box-0", "box-1", "box-2"),
    "shelf": ("shelf-mug", "shelf-box"),
}
"""Tasks by object; those of the shelf are twins of the paper's real ones."""

RUNS = 10
"""Runs of each method and task."""


def _by_task(*columns: tuple[float, ...]) -> dict[str, dict[str, float]]:
    return {method: dict(zip(_TASKS, column, strict=True)) for method, column in zip(METHODS, columns, strict=True)}


SUCCESSES = _by_task(
    (9, 9, 10, 10, 9, 7, 9, 10, 6, 7, 7),
    (3, 5, 6, 9, 9, 7, 9, 9, 6, 0, 3),
    (7, 8, 10, 5, 7, 7, 8, 10, 4, 4, 0),
    (2, 0, 7, 1, 0, 0, 4, 4, 1, 0, 2),
    (0, 0, 0, 6, 10, 0, 0, 10, 1, 1, 3),
)
"""Table V: runs of 10 with a least nll below the threshold, by method and task."""

CUMULATIVE_NLL = _by_task(
    (925, 1447, 1013, 7975, 13750, 24479, 12744, 8109, 23923, 640, 9177),
    (1447, 1598, 827, 10425, 12473, 23892, 12811, 7412, 24675, 1330, 8341),
    (1691, 1591, 1104, 15401, 21627, 27471, 10718, 6596, 43254, 946, 8762),
    (1691, 2252, 1239, 22725, 22835, 33419, 24276, 10183, 31196, 1145, 9994),
    (2478, 2610, 2467, 8369, 6049, 69321, 16527, 4601, 23157, 4652, 7717),
)
"""Table VI: median cumulative nll, by method and task."""

CORRELATION = dict(zip(_TASKS[:9], (0.93, 0.82, 0.84, 0.74, 0.94, 0.94, 0.58, 0.80, 0.49), strict=True))
"""Table II: linear correlation of nll and APC over all methods' runs, by task."""

THRESHOLDS = {"mug": 20, "drill": 100, "box": 150, "shelf-mug": 35, "shelf-box": 250}
"""Table III: nll below which a run counts as a success, by object."""

SECONDS = {
    "cache": {"mug": (0.061, 0.001), "box": (0.387, 0.002)},
    "dynamics": {"mug": (0.724, 0.012), "box": (1.242, 0.054)},
    "cost": {"mug": (0.178, 0.002), "box": (0.556, 0.021)},
    "gp_fit": {"mug": (1.870, 0.066), "box": (2.541, 0.061)},
    "gp_cost": {"mug": (0.116, 0.002), "box": (0.184, 0.004)},
}
"""Table VII: seconds a step, mean and standard deviation, on an RTX 4090, for mug 0 and box 0."""


def family(task: str) -> str:
    """The object of a task: what its name starts with, or the task's own name."""
    return next((name for name, tasks in FAMILIES.items() if task in tasks), task.rpartition("-")[0] or task)
