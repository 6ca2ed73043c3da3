"""Calibrators side by side: plan, run, statistics, report."""
