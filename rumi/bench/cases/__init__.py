"""All cases; importing this enters them in `rumi.bench.case.CASES`, in the order of the table."""

from rumi.bench.cases import (  # noqa: I001  (the order of the table)
    lookup,
    fields,
    discrepancy,
    rollouts,
    trajectory,
    trajectory_update,
    reach,
    sampling,
    planning,
    actions,
    readings,
    loading,
    cold_start,
)

__all__ = [
    "actions",
    "cold_start",
    "discrepancy",
    "fields",
    "loading",
    "lookup",
    "planning",
    "reach",
    "readings",
    "rollouts",
    "sampling",
    "trajectory",
    "trajectory_update",
]
