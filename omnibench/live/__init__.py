"""The live runtime: wheel samples in, calibrated odometry out, over Zenoh."""
