"""Measurements: run time against error, scaling, deadlines."""
