"""Recordings: rosbag1, rosbag2, MCAP."""
