"""Experiment design: which commands are worth driving."""
