"""Scan matching: one scan against a growing map."""
