"""Importer of ROS recordings. Importing the package registers it."""

from omnibench.data.importers.rosbag.rosbag import Rosbag

__all__ = ["Rosbag"]
