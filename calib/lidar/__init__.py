"""The LiDAR beside the cameras: from boards, from pairs of points and pixels, and refined on the scene."""

from calib.lidar.board import CloudBoard, find_in_cloud
from calib.lidar.points import PointsPose, from_points, read_pairs
from calib.lidar.refine import Refinement, SceneFrame, refine_on_scene
from calib.lidar.start import LidarStart, edge_distances, lidar_start

__all__ = [
    "CloudBoard",
    "LidarStart",
    "PointsPose",
    "Refinement",
    "SceneFrame",
    "edge_distances",
    "find_in_cloud",
    "from_points",
    "lidar_start",
    "read_pairs",
    "refine_on_scene",
]
