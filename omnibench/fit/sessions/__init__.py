"""Comparison of sessions: whether robot or reference changed between them."""
