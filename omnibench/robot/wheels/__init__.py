"""Wheels of a robot, and the drive signals that they measure."""
