"""Calibration of RGB + thermal + LiDAR rigs. Nothing is built here yet; see docs/architecture.md."""
