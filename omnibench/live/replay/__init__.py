"""Recordings replayed on Zenoh as a robot and its SLAM would send them."""
