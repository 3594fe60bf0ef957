"""mrcal's calibration of one camera on one regular board, run by the Python that Debian's python3-mrcal belongs to:

    /usr/bin/python3 mrcal_process.py in.npz out.npz

in: centres_px (P, rows, columns, 2), spacing_m, size_px (2,), and as a start intrinsics (9,) of OpenCV's model and
poses (P, 6), rotation vector and translation in m. out: intrinsics (9,), poses (P, 6), warp_m (2,), rms_px.
"""

import sys

import mrcal  # pyright: ignore[reportMissingImports]  # it is not of this environment
import numpy as np

given = np.load(sys.argv[1])
views = len(given["centres_px"])
intrinsics, poses, warp = given["intrinsics"][None].copy(), given["poses"].copy(), np.zeros(2)
found = mrcal.optimize(
    intrinsics=intrinsics,
    extrinsics_rt_fromref=np.zeros((0, 6)),
    frames_rt_toref=poses,
    points=None,
    observations_board=np.concatenate([given["centres_px"], np.ones((*given["centres_px"].shape[:3], 1))], axis=-1),
    indices_frame_camintrinsics_camextrinsics=np.array([[view, 0, -1] for view in range(views)], np.int32),
    observations_point=None,
    indices_point_camintrinsics_camextrinsics=None,
    lensmodel="LENSMODEL_OPENCV5",
    imagersizes=given["size_px"][None].astype(np.int32),
    calobject_warp=warp,
    do_optimize_calobject_warp=True,
    calibration_object_spacing=float(given["spacing_m"]),
    do_apply_outlier_rejection=False,
    do_apply_regularization=False,
)
np.savez(sys.argv[2], intrinsics=intrinsics[0], poses=poses, warp_m=warp, rms_px=found["rms_reproj_error__pixels"])
