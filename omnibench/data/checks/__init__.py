"""Warnings of wrong units, wheels and steering angles, with which the recordings would make more sense."""
