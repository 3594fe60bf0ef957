"""What others find markers with: image -> centres (N, 2) px in any order, or None when the target is not found."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from thermostand.markers.target import Target

Image = NDArray[np.uint8] | NDArray[np.uint16]
Float = NDArray[np.float64]
Peer = Callable[[Image], Float | None]

STRONGEST = "SimpleBlob, step 2"
COMMON = "findCirclesGrid, defaults"
_LEAST_AREA_px2 = 300


def opencv_peers(target: Target) -> dict[str, Peer]:
    """findCirclesGrid as it comes and tuned, and the blob detector at its best: 75 thresholds, which together are a
    grey moment. 35..185 DN is the best of the ranges tried in even light (50..200: 3.6 mpx, 40..190: 2.6,
    35..185: 2.4)."""
    size = (target.columns, target.rows)
    return {
        COMMON: lambda image: _grid(image, size, cv2.SimpleBlobDetector.create()),
        "findCirclesGrid, tuned": lambda image: _grid(image, size, _blobs(40, 180, 20)),
        STRONGEST: lambda image: _centres(_blobs(35, 185, 2).detect(image)),
    }


def _blobs(lowest_DN: float, highest_DN: float, step_DN: float) -> cv2.SimpleBlobDetector:
    chosen = cv2.SimpleBlobDetector.Params()
    chosen.minThreshold, chosen.maxThreshold, chosen.thresholdStep = lowest_DN, highest_DN, step_DN
    chosen.minArea, chosen.maxArea, chosen.minDistBetweenBlobs = _LEAST_AREA_px2, 2e5, 20
    chosen.filterByInertia, chosen.minConvexity = False, 0.9
    return cv2.SimpleBlobDetector.create(chosen)


def _grid(image: Image, size: tuple[int, int], detector: cv2.SimpleBlobDetector) -> Float | None:
    found, centres = cv2.findCirclesGrid(image, size, flags=cv2.CALIB_CB_SYMMETRIC_GRID, blobDetector=detector)
    return centres.reshape(-1, 2).astype(np.float64) if found else None


def _centres(keypoints: Sequence[cv2.KeyPoint]) -> Float:
    return np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64).reshape(-1, 2)
