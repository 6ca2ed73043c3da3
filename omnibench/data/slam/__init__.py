"""Reference poses from laser scans alone: scan matching against a growing map."""
