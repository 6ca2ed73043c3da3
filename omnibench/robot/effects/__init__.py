"""Terms that can be added to the odometry model, one family a file; plug-ins register theirs beside them."""
