"""The exam of check: a table, makers of faults, a judge."""
