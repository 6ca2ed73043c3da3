"""Messages on the wire: ROS 2 types, topics, MCAP files, Foxglove."""
