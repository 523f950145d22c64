"""Beliefs over an object's pose, and the filters that update them."""
