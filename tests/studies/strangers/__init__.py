"""Strangers' robots: a table of recordings with what is right of them, their makers, and the judge."""
