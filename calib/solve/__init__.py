"""The joint solve: all cameras, boards, poses and the LiDAR in one least-squares problem."""
