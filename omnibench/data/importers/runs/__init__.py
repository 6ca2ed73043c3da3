"""Runs of a recording: its reference as it is to be read, and where one run ends and another begins."""
