"""A proven lower bound of the cost over a box."""
