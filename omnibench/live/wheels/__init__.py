"""Wheel messages put in order, repaired or refused: how the wheels turned and steered from sample to sample."""
