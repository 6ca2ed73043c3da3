"""Smooth functions of covariates, for effects that nobody knows. Importing registers them."""

from omnibench.robot.effects.smooth import motion, reference, wheels

__all__ = ["motion", "reference", "wheels"]
