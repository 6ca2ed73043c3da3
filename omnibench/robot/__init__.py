"""Model of the robot: kinematics, odometry, effects and the calibration file."""
