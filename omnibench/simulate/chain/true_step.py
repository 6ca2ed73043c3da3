"""The time step in which the true motion of a simulated robot is known."""

TRUE_STEP = 1e-3  # s between true wheel angles (chosen: a tenth of the shortest usual sample period)
