"""Measurements: hot operations against peers, run time against error, scaling."""
