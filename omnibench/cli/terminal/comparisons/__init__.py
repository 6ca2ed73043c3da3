"""Comparisons and studies on a terminal."""
