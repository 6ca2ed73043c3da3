"""Weighted least squares of whole reference trajectories: noise, nuisances, steps."""
