"""Calibrates with mrcal what a file holds, where mrcal is installed: the oracle of test_calib_mrcal.py.

Run by a Python that has mrcal: `python mrcal_oracle.py views.npz answer.json`. The file holds `uv` (K, R,
C, 2) px of one camera's views of a grid of R x C corners, `spacing_m`, `size_wh`, `start` (fx fy cx cy),
`pose` (K, 6: rotation vector and translation, camera from board) to start from, and `at` (M, 3) metres in
the camera's frame.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np


def main(views: Path, answer: Path) -> None:
    import mrcal  # type: ignore[import-not-found]

    given = np.load(views)
    uv = given["uv"]
    count, rows, columns = uv.shape[:3]
    board = np.concatenate([uv, np.ones((count, rows, columns, 1))], -1)
    which = np.zeros((count, 3), np.int32)
    which[:, 0], which[:, 2] = np.arange(count), -1
    inputs: dict[str, Any] = {
        "intrinsics": np.concatenate([given["start"], np.zeros(5)])[None],
        "rt_cam_ref": np.zeros((0, 6)),
        "rt_ref_frame": given["pose"].copy(),
        "points": None,
        "observations_board": board,
        "indices_frame_camintrinsics_camextrinsics": which,
        "observations_point": None,
        "indices_point_camintrinsics_camextrinsics": None,
        "lensmodel": "LENSMODEL_OPENCV5",
        "imagersizes": given["size_wh"].astype(np.int32)[None],
        "calobject_warp": None,
        "do_optimize_intrinsics_core": True,
        "do_optimize_intrinsics_distortions": True,
        "do_optimize_extrinsics": False,
        "do_optimize_frames": True,
        "do_optimize_calobject_warp": False,
        "calibration_object_spacing": float(given["spacing_m"]),
        "do_apply_outlier_rejection": False,
        "do_apply_regularization": False,
        "verbose": False,
    }
    found = mrcal.optimize(**inputs)
    model = mrcal.cameramodel(optimization_inputs=inputs, icam_intrinsics=0)
    covariance = mrcal.projection_uncertainty(given["at"], model, what="covariance")
    result = {
        "intrinsics": inputs["intrinsics"][0].tolist(),
        "rms_px": float(found["rms_reproj_error__pixels"]),
        "covariance": np.asarray(covariance).tolist(),
    }
    answer.write_text(json.dumps(result))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
