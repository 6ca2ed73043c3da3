"""Regressors: columns by which the residuals may depend on something, and their significance."""
