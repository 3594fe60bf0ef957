"""Marker detection beside cv2.findCirclesGrid with its defaults: time and error on the same rendered 5 MP frames.

The frames and their true centres come from the tests' own renderer, which shares no code with the program or with the
simulator. An error is the root mean square of one coordinate over all markers of all frames.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from compensation.markers.detection import Detection, detect
from compensation.target import Target, load_target
from stand.config import packaged
from tests.bench.figures import Figure, in_turns, milliseconds, progress, side_by_side
from tests.compensation.rendered import Scene, photograph, render, true_centres_px

ROUNDS = 9
SHIFTS_mm = ((0.0, 0.0), (0.04, -0.02), (0.07, 0.05))  # of the target, from frame to frame
PEER = "cv2.findCirclesGrid, defaults"

Image = NDArray[np.uint8] | NDArray[np.uint16]
Float = NDArray[np.float64]


def figures(directory: Path) -> list[Figure]:
    """ms for a first and for a tracked frame, and the errors of both."""
    target = load_target(packaged("targets", "paper-9x6"))
    progress("markers, rendering the frames")
    scenes = [Scene(shift_mm=shift_mm, tilt_y_deg=5, roll_deg=1) for shift_mm in SHIFTS_mm]
    images = [photograph(scene, render(scene), seed) for seed, scene in enumerate(scenes)]
    truths = [true_centres_px(scene) for scene in scenes]
    progress("markers, detection")
    previous = detect(images[0], target)
    return [
        _time("markers, first 5 MP frame", images[1], target, None),
        _time("markers, tracked 5 MP frame", images[1], target, previous),
        *_errors(images, truths, target),
    ]


def _time(what: str, image: Image, target: Target, previous: Detection | None) -> Figure:
    size = (target.columns, target.rows)
    own, other = in_turns(
        lambda: milliseconds(lambda: detect(image, target, previous)),
        lambda: milliseconds(lambda: cv2.findCirclesGrid(image, size)),
        ROUNDS,
    )
    return side_by_side(what, "ms/frame", PEER, own, other)


def _errors(images: list[Image], truths: list[Float], target: Target) -> list[Figure]:
    firsts = [detect(image, target) for image in images]
    tracked = firsts[:1]
    for image in images[1:]:
        tracked.append(detect(image, target, tracked[-1]))
    peer_mpx = _rms_mpx(
        [_circles_grid(image, truth, target) for image, truth in zip(images, truths, strict=True)], truths
    )
    return [
        side_by_side(what, "mpx RMS", PEER, [_rms_mpx([found.centres_px for found in detections], truths)], [peer_mpx])
        for what, detections in (("markers, error, first frames", firsts), ("markers, error, tracked", tracked))
    ]


def _circles_grid(image: Image, truth: Float, target: Target) -> Float:
    """The peer's centres in the order of `truth`; it numbers them its own way."""
    found, centres = cv2.findCirclesGrid(image, (target.columns, target.rows))
    if not found:
        raise ValueError(f"{PEER} does not find the target")
    candidates = centres.reshape(-1, 2).astype(np.float64)
    distances = np.linalg.norm(truth[:, None] - candidates[None], axis=2)
    return candidates[distances.argmin(axis=1)]


def _rms_mpx(centres_px: list[Float], truths_px: list[Float]) -> float:
    return 1e3 * float(np.sqrt(np.mean((np.array(centres_px) - np.array(truths_px)) ** 2)))
