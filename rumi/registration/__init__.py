"""Fitting poses to observed points."""
