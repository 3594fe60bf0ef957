"""Claimed variances of marker centres against true errors: chi^2 per coordinate, 1 when they are honest.

The worse of x and y, as chi^2 or its inverse. Two scenes, with discs of 17 and 10 px radius, of poses, seeds and angles
of motion that nothing was chosen on. Where frames are reported to be suspect there is no goal: that is what is to be
reported.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from statistics import mean

import cv2
import numpy as np

from tests.bench.figures import Figure, make_absolute, report_progress, set_upper_goal
from tests.compensation.degraded_images import (
    Picture,
    make_jpeg_picture,
    make_motion_blur_picture,
    photograph_flickering_rows,
    photograph_grained_paper,
    photograph_unequal_pixels,
    photograph_with_gamma,
    photograph_with_noise,
)
from tests.compensation.renderer import Float, Scene, compute_true_centres_px, render
from thermostand.markers.detection import Detection, detect
from thermostand.markers.target import load_target
from thermostand.stand.config.stand_config import find_packaged

FRAMES = 24
CLEAN_FRAMES = 100
FIRST_SEED = 7000
GOAL = 1.25
_FALSE_ALARMS = 0.01
SCENES = {
    "17 px": Scene(size=(1224, 1024), f_px=4386, roll_deg=31, tilt_x_deg=-14, distance_mm=1150),
    "10 px": Scene(size=(1224, 1024), f_px=2700, roll_deg=12, tilt_y_deg=-20, distance_mm=1080),
}
PICTURES: dict[str, Picture] = {
    "noise alone": photograph_with_noise,
    **{f"JPEG {quality}": make_jpeg_picture(quality) for quality in (95, 90, 80)},
    **{f"motion of {length} px": make_motion_blur_picture(length, 110) for length in (2, 4, 6, 8)},
    "unequal pixels, 2 %": photograph_unequal_pixels,
    "gamma 2.2": photograph_with_gamma,
    "flickering rows, 3 DN": photograph_flickering_rows,
    "grained paper": photograph_grained_paper,
}


def figures(directory: Path) -> list[Figure]:
    """chi^2 of each kind of picture, blur included, and how many of its frames are reported to be suspect."""
    cv2.setNumThreads(1)
    lines: list[Figure] = []
    for size, scene in SCENES.items():
        report_progress(f"claimed variances, discs of {size}")
        clean = render(scene)
        for name, picture in PICTURES.items():
            lines.append(_make_figure(f"{name}, discs of {size}", scene, clean, picture))
        for blur in (0.6, 2.5):
            blurred = replace(scene, psf_px=blur)
            lines.append(
                _make_figure(f"blur {blur} px, discs of {size}", blurred, render(blurred), photograph_with_noise)
            )
    return [*lines, _count_false_alarms()]


def _count_false_alarms() -> Figure:
    """Frames of noise alone, none of them in the lines above, that are reported to be suspect."""
    target = load_target(find_packaged("targets", "paper-9x6"))
    suspect: list[bool] = []
    for number, (size, scene) in enumerate(SCENES.items()):
        report_progress(f"false alarms, discs of {size}")
        clean, first = render(scene), FIRST_SEED + 1000 * (number + 1)
        found = [
            detect(photograph_with_noise(scene, clean, seed), target) for seed in range(first, first + CLEAN_FRAMES)
        ]
        suspect += [detection.is_suspect for detection in found]
    return set_upper_goal(
        _FALSE_ALARMS, make_absolute(f"suspect of {len(suspect)} frames of noise alone", "", [mean(suspect)])
    )


def _make_figure(name: str, scene: Scene, clean: Float, picture: Picture) -> Figure:
    target = load_target(find_packaged("targets", "paper-9x6"))
    found = [detect(picture(scene, clean, FIRST_SEED + number), target) for number in range(FRAMES)]
    chi2 = _compute_chi2(found, compute_true_centres_px(scene))
    suspect = sum(detection.is_suspect for detection in found)
    reported = f" ({suspect} of {FRAMES} frames suspect)" if suspect else ""
    figure = make_absolute(f"claimed variances, {name}{reported}", "chi^2", [max(*chi2, *(1 / chi2))])
    return figure if suspect > FRAMES / 2 else set_upper_goal(GOAL, figure)


def _compute_chi2(found: list[Detection], truth: Float) -> Float:
    """Of the unflagged markers, along x and y."""
    squares = np.array(
        [(one.centres_px - truth) ** 2 / np.diagonal(one.covariance_px2, axis1=1, axis2=2) for one in found]
    )
    clear = np.array([one.flags == 0 for one in found])
    return np.nanmean(np.where(clear[:, :, None], squares, np.nan), axis=(0, 1))
