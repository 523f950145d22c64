"""How good a belief is, and how sure to be of an experiment."""
