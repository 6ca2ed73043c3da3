"""Screening and model selection: which effects of the catalogue are missing, and how sure that is."""
