"""Messages on the network and in files: ROS 2 types, topics, MCAP recordings, Foxglove."""
