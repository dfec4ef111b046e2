"""Poisson safety filter: point cloud or occupancy grid in, safe velocity out. Usable alone."""
