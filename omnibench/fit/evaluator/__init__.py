"""Costs and poses of many candidate matrices at once."""
