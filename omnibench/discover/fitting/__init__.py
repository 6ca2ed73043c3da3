"""Fitting a model to runs: which runs and poses, their nuisances, the plain matrix, the matrix with effects."""
