"""Poses of many candidate matrices at once."""
