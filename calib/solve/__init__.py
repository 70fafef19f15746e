"""The joint solve: all cameras, boards, poses and the LiDAR in one least-squares problem."""

from calib.solve.bundle import solve
from calib.solve.estimate import Estimate, Solution
from calib.solve.motion import exp_motion

__all__ = ["Estimate", "Solution", "exp_motion", "solve"]
