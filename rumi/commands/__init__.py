"""The commands of `rumi`, one file each."""
