"""Fit of a model to recordings: costs, the calibration problem, calibrators, uncertainty."""
