"""Discovery of effects that the model of a robot lacks: where they show, which they are, how much better it gets."""
