"""Recording runs and reading them back."""
