"""Calibrations for other software, one format a file."""
