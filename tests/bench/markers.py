"""Marker detection on rendered 5 MP frames: error against the physical limit, time, and what OpenCV does beside it.

The frames and their true centres come from the tests' own renderer, which shares no code with the program or with the
simulator. An error is the root mean square of one coordinate over all markers of all frames. The limit is that of
Cramer and Rao with two photometric planes for each scene. Times are of one thread.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from compensation.markers.detection import Detection, Noise, detect
from compensation.target import Target, load_target
from stand.config import packaged
from tests.bench.figures import (
    Figure,
    absolute,
    at_most,
    in_turns,
    milliseconds,
    progress,
    side_by_side,
    skipped,
)
from tests.compensation.rendered import Scene, photograph, render, shaded_light, true_centres_px

ROUNDS = 5
FRAMES = 4

Image = NDArray[np.uint8] | NDArray[np.uint16]
Float = NDArray[np.float64]
Peer = Callable[[Image], Float | None]

SCENES = {
    "A even light": (Scene(), 2.21),
    "B sharp, psf 0.8": (Scene(psf_px=0.8), 1.97),
    "C psf 1.5, read 2": (Scene(psf_px=1.5, read_DN=2), 3.78),
    "D shaded": (Scene(light=shaded_light), 2.21),
    "E tilt 30": (Scene(tilt_y_deg=30, tilt_x_deg=5, roll_deg=20, distance_mm=1040), 2.47),
    "F tilt 45": (Scene(tilt_y_deg=45, distance_mm=1040), 2.76),
    "G defocus, psf 3": (Scene(psf_px=3), 4.38),
    "J distortion, tilt 20": (Scene(k1=-0.15, k2=0.1, tilt_y_deg=20), 2.21),
}
"""Scene and Cramer-Rao limit, mpx."""


def figures(directory: Path) -> list[Figure]:
    """ms for a first and for a tracked frame, then the errors of each scene, ours and the peers'."""
    cv2.setNumThreads(1)
    target = load_target(packaged("targets", "paper-9x6"))
    peers = _peers(target)
    lines: list[Figure] = []
    for name, (scene, limit_mpx) in SCENES.items():
        progress(f"markers, scene {name}")
        clean, truth = render(scene), true_centres_px(scene)
        images = [photograph(scene, clean, seed) for seed in range(FRAMES)]
        if name.startswith("A"):
            lines += _times(images, target, peers)
        lines += _errors(name, scene, limit_mpx, clean, images, truth, target, peers)
    return [*lines, skipped("markers, scikit-image regionprops", "scikit-image is not a dependency")]


def _peers(target: Target) -> dict[str, Peer]:
    size = (target.columns, target.rows)
    return {
        "findCirclesGrid, defaults": lambda image: _grid(image, size, cv2.SimpleBlobDetector.create()),
        "findCirclesGrid, tuned": lambda image: _grid(image, size, _blobs(40, 180, 20)),
        "SimpleBlob, step 2": lambda image: _centres(_blobs(50, 200, 2).detect(image)),
    }


def _blobs(lowest_DN: float, highest_DN: float, step_DN: float) -> cv2.SimpleBlobDetector:
    chosen = cv2.SimpleBlobDetector.Params()
    chosen.minThreshold, chosen.maxThreshold, chosen.thresholdStep = lowest_DN, highest_DN, step_DN
    chosen.minArea, chosen.maxArea, chosen.minDistBetweenBlobs = 300, 2e5, 20
    chosen.filterByInertia, chosen.minConvexity = False, 0.9
    return cv2.SimpleBlobDetector.create(chosen)


def _grid(image: Image, size: tuple[int, int], detector: cv2.SimpleBlobDetector) -> Float | None:
    found, centres = cv2.findCirclesGrid(image, size, flags=cv2.CALIB_CB_SYMMETRIC_GRID, blobDetector=detector)
    return centres.reshape(-1, 2).astype(np.float64) if found else None


def _centres(keypoints: tuple[cv2.KeyPoint, ...]) -> Float:
    return np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64).reshape(-1, 2)


def _processor_ms(work: Callable[[], object]) -> list[float]:
    """What `work` takes of one core, ms; other programs on the machine do not count."""
    work()
    times_ms: list[float] = []
    for _ in range(2 * ROUNDS):
        begin_s = time.thread_time()
        work()
        times_ms.append(1e3 * (time.thread_time() - begin_s))
    return times_ms


def _times(images: list[Image], target: Target, peers: dict[str, Peer]) -> list[Figure]:
    previous = detect(images[0], target)
    lines: list[Figure] = []
    for what, before, goal_ms in (("first", None, 60), ("tracked", previous, 10)):
        own_ms = _processor_ms(lambda before=before: detect(images[1], target, before))
        lines.append(at_most(goal_ms, absolute(f"markers, {what} 5 MP frame, one core", "ms", own_ms)))
        for peer, search in peers.items():
            own, other = in_turns(
                lambda before=before: milliseconds(lambda: detect(images[1], target, before)),
                lambda search=search: milliseconds(lambda: search(images[1])),
                ROUNDS,
            )
            lines.append(side_by_side(f"markers, {what} 5 MP frame", "ms", peer, own, other))
    return lines


def _errors(
    name: str,
    scene: Scene,
    limit_mpx: float,
    clean: Float,
    images: list[Image],
    truth: Float,
    target: Target,
    peers: dict[str, Peer],
) -> list[Figure]:
    noise = Noise(scene.read_DN**2 + 1 / 12, 1 / scene.electrons_per_DN)
    found = _tracked(images, target, noise)
    error_mpx = _rms_mpx([detection.centres_px for detection in found], truth)
    sigma_mpx = 1e3 * float(np.sqrt(np.nanmean([np.diagonal(one.covariance_px2, axis1=1, axis2=2) for one in found])))
    # 12 bits more than the noisy frames have: what is left is the model's.
    fine = detect(np.round(clean * 200).astype(np.uint16), target, noise=Noise(1.0, 1 / 40))
    limit = side_by_side(f"{name}: error", "mpx RMS", "Cramer-Rao limit", [error_mpx], [limit_mpx])
    lines = [
        at_most(1.15 * limit_mpx, limit),
        at_most(0.1, absolute(f"{name}: bias", "mpx RMS", [_rms_mpx([fine.centres_px], truth)])),
        at_most(0.1, absolute(f"{name}: predicted over actual sigma, off 1", "", [abs(sigma_mpx / error_mpx - 1)])),
    ]
    for peer, search in peers.items():
        centres = [search(image) for image in images]
        usable = [_in_order(points, truth) for points in centres if points is not None and len(points)]
        if len(usable) < len(images):
            lines.append(skipped(f"{name}: {peer}", "it does not find the target"))
        else:
            lines.append(side_by_side(f"{name}: error", "mpx RMS", peer, [error_mpx], [_rms_mpx(usable, truth)]))
    return lines


def _tracked(images: list[Image], target: Target, noise: Noise) -> list[Detection]:
    found = [detect(images[0], target, noise=noise)]
    for image in images[1:]:
        found.append(detect(image, target, found[-1], noise))
    return found


def _in_order(centres: Float, truth: Float) -> Float:
    """A peer's centres in the order of `truth`; it numbers them its own way."""
    return centres[np.linalg.norm(truth[:, None] - centres[None], axis=2).argmin(axis=1)]


def _rms_mpx(centres_px: list[Float], truth_px: Float) -> float:
    return 1e3 * float(np.sqrt(np.nanmean((np.array(centres_px) - truth_px) ** 2)))
