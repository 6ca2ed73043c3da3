"""Effects: terms that can be added to the odometry model, one family in each file. Importing registers them."""
