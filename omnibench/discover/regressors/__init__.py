"""Regressors that say where the residual depends on something, and how surprising that is."""
