"""What the robot is: kinematics, odometry, effects and the calibration file."""
