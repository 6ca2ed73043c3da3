"""Recordings: data sets on disk, importers, and checks of what they hold."""
