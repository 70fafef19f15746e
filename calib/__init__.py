"""Calibration of RGB + thermal + LiDAR rigs: from boards, or from the scene, to a `fusion.rig.Rig` with its
evidence."""
