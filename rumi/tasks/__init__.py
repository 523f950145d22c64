"""Tasks: what there is to find, each with its scene, its agent and its settings."""
