"""Fusion: SLAM poses and odometry brought together, each at its own time."""
