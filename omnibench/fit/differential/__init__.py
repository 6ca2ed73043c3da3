"""Differential drives with two wheels: their axle, and the squares that calibrations drive with them."""
