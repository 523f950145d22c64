"""Information measures: entropy of weighted samples, expected information gain, stopping rules."""
