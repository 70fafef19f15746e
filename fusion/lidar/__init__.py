"""The LiDAR lane: a cloud, a camera to look at it with, samples, a dense map and its support."""
