"""Simulated recordings of known truth."""
