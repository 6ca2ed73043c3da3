"""Terms that can be added to the odometry model, one family a file. None is built in yet; plug-ins register here."""
