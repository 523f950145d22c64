"""Maps over the workspace."""
