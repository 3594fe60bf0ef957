"""Images moved by a drift, beside cv2.remap with its best interpolation: time, and what happens to the markers.

The frame is rendered with 16 bits and without noise, so that the error is the interpolation's own. Times are of one
core, without what other programs take of it; reading and writing the pixels once takes about 3 ms of them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.bench.figures import Figure, compare, measure_in_turns, measure_processor_ms, report_progress, set_upper_goal
from tests.compensation.renderer import Scene, render
from thermostand.compensation.apply.image_correction import warp
from thermostand.compensation.drift_runtime import source_offset
from thermostand.markers.detection import detect
from thermostand.markers.target import load_target
from thermostand.stand.config.stand_config import find_packaged

ROUNDS = 7
NOT_SPLIT: Any = None  # its stub wants two maps
PEER = "cv2.remap, Lanczos 8x8"

Float = NDArray[np.float64]


def figures(directory: Path) -> list[Figure]:
    """ms per 5 MP frame, and mpx RMS of the markers."""
    report_progress("warp, rendering the frame")
    cv2.setNumThreads(1)
    scene = Scene(psf_px=0.8, tilt_y_deg=4, roll_deg=1)
    image = (256 * render(scene)).astype(np.uint16)
    width, height = scene.size
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    at = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
    at = (at + source_offset(_drift, at)).astype(np.float32).reshape(height, width, 2)
    own, other = measure_in_turns(
        lambda: measure_processor_ms(lambda: warp(image, _drift)),
        lambda: measure_processor_ms(lambda: cv2.remap(image, at, NOT_SPLIT, cv2.INTER_LANCZOS4)),
        ROUNDS,
    )
    target = load_target(find_packaged("targets", "paper-9x6"))
    before = detect(image, target).centres_px
    expected = before + _drift(before)
    errors = [
        1e3 * float(np.sqrt(((detect(cast(Any, moved), target).centres_px - expected) ** 2).mean()))
        for moved in (
            np.round(warp(image, _drift)).astype(np.uint16),
            cv2.remap(image, at, NOT_SPLIT, cv2.INTER_LANCZOS4),
        )
    ]
    return [
        set_upper_goal(25, compare("warp, 5 MP frame", "ms/frame", PEER, own, other)),
        set_upper_goal(0.5, compare("warp, error of the markers", "mpx RMS", PEER, errors[:1], errors[1:])),
    ]


def _drift(xy_px: Float) -> Float:
    x, y = (xy_px[:, 0] - 1223.5) / 1224, (xy_px[:, 1] - 1023.5) / 1224
    return np.stack([0.42 + 0.05 * x - 0.03 * x * y, -0.55 + 0.06 * y + 0.02 * y * y], axis=1)
