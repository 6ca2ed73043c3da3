"""Runs that a model was not fitted to, and its errors on them: folds of the training runs, and the validation split."""
