"""Where simulation and measurement disagree, what is missing, and how much better the model is with it."""
