"""Odometry of runs whose samples are read where they are used."""
