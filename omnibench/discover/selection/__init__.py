"""Model selection: which effects of the catalogue are missing."""
