"""Policies: the choice of the next actions."""
