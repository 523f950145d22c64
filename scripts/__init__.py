"""Experiments: benchmarks, the papers' tables, examples; run from a checkout."""
