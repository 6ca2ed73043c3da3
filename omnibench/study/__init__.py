"""Calibrators on several robots and kinds of path: what each is worth where it was not fitted."""
