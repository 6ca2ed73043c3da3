"""How well a design is known, and the shrinkage of answers to it."""
