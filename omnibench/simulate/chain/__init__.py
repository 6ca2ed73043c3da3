"""A robot simulated from command to SLAM: motors, encoders, room, LIDAR."""
