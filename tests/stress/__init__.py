"""Numerical stress: sweeps of public operations against references of higher precision, fuzz, kills and long runs."""
