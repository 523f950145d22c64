"""Fields over the workspace: information, semantics and expected normals."""
