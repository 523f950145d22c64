"""`rumi bench`: how long the work takes, against itself, against others and against the targets."""
