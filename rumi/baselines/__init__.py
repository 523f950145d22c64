"""Policies to compare RUMI with."""
