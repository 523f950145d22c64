"""Metrics of beliefs, and confidence intervals of experiments."""
