"""omnibench."""
