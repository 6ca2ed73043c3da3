"""How a model is fitted to recordings: costs, the calibration problem, calibrators."""
