"""A robot's state: from wheel messages and pose measurements to odometry and fused poses."""
