"""The mug with a handle, followed by all sensors at once, then lifted by its handle."""
