"""Figures of recorded runs; functions take data and an axis and return the axis. Needs the extra `plot`."""
