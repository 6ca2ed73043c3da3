"""Public recordings: the catalogue of those that are known, clones of their repositories, and their import."""
