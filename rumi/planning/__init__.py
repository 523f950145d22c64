"""Choosing the next actions."""
