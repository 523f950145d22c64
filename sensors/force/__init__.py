"""Forces: wrenches at a tool, its load and surface, joint torques."""
