"""How well models predict runs that they were not fitted to: folds of the training runs, and the validation split."""
