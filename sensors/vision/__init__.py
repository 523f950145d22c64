"""Depth images and point clouds: cameras, segmentation, filters, files."""
