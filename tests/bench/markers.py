"""Marker detection on rendered 5 MP frames: error against the physical limit, time, and what others do beside it.

The frames and their true centres come from the tests' own renderer, which shares no code with the program or with the
simulator. An error is the root mean square of one coordinate over all markers of all frames; a marker that is flagged,
but for refitted ones, or not found, does not count. The limit is that of Cramer and Rao with two photometric planes for
each scene. Times are of one thread.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from tests.bench.figures import (
    Figure,
    absolute,
    at_most,
    in_turns,
    processor_ms,
    progress,
    ratio_at_most,
    side_by_side,
    skipped,
)
from tests.bench.marker_peers import COMMON, STRONGEST, Float, Image, Peer, opencv_peers
from tests.compensation.rendered import Scene, photograph, project, render, shaded_light, true_centres_px
from thermostand.markers.detection import Detection, Flag, Noise, detect
from thermostand.markers.eccentricity import disc_centres_px
from thermostand.markers.target import Target, load_target
from thermostand.stand.config.stand_config import packaged

ROUNDS = 5
FRAMES = 4

_FOUND_WITHIN_PX = 60
_SEEN = np.uint8(Flag.REFITTED | Flag.SATURATED)


def strongly_shaded(u: Float, v: Float) -> Float:
    """80 % along x, -50 % along y."""
    return 1 + 0.4 * (u - 1223.5) / 1223.5 - 0.25 * (v - 1023.5) / 1023.5


def as_it_is(clean: Float, truth: Float) -> Float:
    return clean


def scattered(clean: Float, truth: Float) -> Float:
    """Light on top of everything: 25 DN, 200 px wide, in the middle."""
    v, u = np.ogrid[:2048, :2448]
    return clean + 25 * np.exp(-((u - 1223.5) ** 2 + (v - 1023.5) ** 2) / (2 * 200.0**2))


def under_glare(clean: Float, truth: Float) -> Float:
    """Three saturating spots on markers' outlines."""
    v, u = np.ogrid[:2048, :2448]
    spots = zip(truth[[9, 26, 43]], (0.3, 2.5, 4.4), (8.0, 14.0, 22.0), strict=True)
    for (x, y), angle, width in spots:
        x, y = x + 35 * np.cos(angle), y + 35 * np.sin(angle)
        clean = clean + 500 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * width**2))
    return clean


def occluded(clean: Float, truth: Float) -> Float:
    """A sheet of 90 DN over a quarter of each disc of the first column."""
    covered = 0.5 - 0.5 * np.tanh(0.85 * (np.arange(2448) - (truth[0, 0] - 14)))
    return clean + (90 - clean) * covered


@dataclass(frozen=True, slots=True)
class Case:
    """A scene, its Cramer-Rao limit in mpx, and what lies over the picture. flat: under perfectly even light, where a
    blob detector with many thresholds is as good as the optimum; nobody is that much better."""

    scene: Scene
    limit_mpx: float
    over: Callable[[Float, Float], Float] = as_it_is
    flat: bool = False


CASES = {
    "A even light": Case(Scene(), 2.21, flat=True),
    "B sharp, psf 0.8": Case(Scene(psf_px=0.8), 1.97, flat=True),
    "C psf 1.5, read 2": Case(Scene(psf_px=1.5, read_DN=2), 3.78, flat=True),
    "D shaded": Case(Scene(light=shaded_light), 2.21),
    "D2 strongly shaded": Case(Scene(light=strongly_shaded, disc_DN=20, ground_DN=150), 2.61),
    "E tilt 30": Case(Scene(tilt_y_deg=30, tilt_x_deg=5, roll_deg=20, distance_mm=1040), 2.47),
    "F tilt 45": Case(Scene(tilt_y_deg=45, distance_mm=1040), 2.76),
    "G defocus, psf 3": Case(Scene(psf_px=3), 4.38),
    "H glare": Case(Scene(), 2.21, under_glare),
    "I occluder": Case(Scene(), 2.21, occluded),
    "J distortion, tilt 20": Case(Scene(k1=-0.15, k2=0.1, tilt_y_deg=20), 2.21),
    "K scattered light": Case(Scene(), 2.21, scattered),
}


def figures(directory: Path) -> list[Figure]:
    """ms for a first and for a tracked frame, then the errors of each scene, ours and the peers'."""
    cv2.setNumThreads(1)
    target = load_target(packaged("targets", "paper-9x6"))
    peers = opencv_peers(target)
    lines: list[Figure] = []
    for name, case in CASES.items():
        progress(f"markers, scene {name}")
        truth, bare = true_centres_px(case.scene), render(case.scene)
        clean = case.over(bare, truth)
        images = [photograph(case.scene, clean, seed) for seed in range(FRAMES)]
        before = detect(photograph(case.scene, bare, FRAMES), target, noise=_noise(case.scene))
        if name.startswith("A"):
            lines += _times(images, target, peers)
        found = _tracked(images, target, before, _noise(case.scene))
        if case.over in (under_glare, occluded):
            lines += _honesty(name, found, truth)
        else:
            lines += _limits(name, case, clean, found, truth, target)
            lines.append(_discs(name, case, found, target))
        lines += _beside(name, case, images, found, truth, peers)
    return lines


def _times(images: list[Image], target: Target, peers: dict[str, Peer]) -> list[Figure]:
    previous = detect(images[0], target)
    lines: list[Figure] = []
    for what, before, goal_ms in (("first", None, 15), ("tracked", previous, 3)):
        own_ms = [processor_ms(lambda before=before: detect(images[1], target, before)) for _ in range(2 * ROUNDS + 1)]
        lines.append(at_most(goal_ms, absolute(f"markers, {what} 5 MP frame, one core", "ms", own_ms[1:])))
        for peer, search in peers.items():
            own, other = in_turns(
                lambda before=before: processor_ms(lambda: detect(images[1], target, before)),
                lambda search=search: processor_ms(lambda: search(images[1])),
                ROUNDS,
            )
            beside = side_by_side(f"markers, {what} 5 MP frame, one core", "ms", peer, own, other)
            lines.append(ratio_at_most(0.1, beside) if peer == COMMON and before is None else beside)
    return lines


def _limits(name: str, case: Case, clean: Float, found: list[Detection], truth: Float, target: Target) -> list[Figure]:
    """Error against the limit, bias, and the honesty of the covariance."""
    error_mpx = _rms_mpx([_usable(detection) for detection in found], truth)
    sigma_mpx = 1e3 * float(np.sqrt(np.nanmean([np.diagonal(one.covariance_px2, axis1=1, axis2=2) for one in found])))
    # 12 bits more than the noisy frames have: what is left is the model's.
    fine = detect(np.round(clean * 200).astype(np.uint16), target, noise=Noise(1.0, 1 / 40))
    limit = side_by_side(f"{name}: error", "mpx RMS", "Cramer-Rao limit", [error_mpx], [case.limit_mpx])
    return [
        at_most(1.15 * case.limit_mpx, limit),
        at_most(0.1, absolute(f"{name}: bias", "mpx RMS", [_rms_mpx([fine.centres_px], truth)])),
        at_most(0.1, absolute(f"{name}: predicted over actual sigma, off 1", "", [abs(sigma_mpx / error_mpx - 1)])),
    ]


def _discs(name: str, case: Case, found: list[Detection], target: Target) -> Figure:
    """Error of the images of the discs' own centres against the limit of the outlines'."""
    middles = project(case.scene, case.scene.discs_mm()[:, :2])
    error_mpx = _rms_mpx([disc_centres_px(detection, target) for detection in found], middles)
    limit = side_by_side(f"{name}: discs' centres", "mpx RMS", "Cramer-Rao limit", [error_mpx], [case.limit_mpx])
    return ratio_at_most(2.5 if case.scene.k1 else 1.2, limit)


def _honesty(name: str, found: list[Detection], truth: Float) -> list[Figure]:
    """How many markers are flagged and refitted, and how far one is off that is said to be right."""
    flags = np.concatenate([detection.flags for detection in found])
    error = np.concatenate([_usable(detection) - truth for detection in found])
    seen = np.isfinite(error[:, 0])
    covariance = np.concatenate([detection.covariance_px2 for detection in found])[seen]
    sigmas = np.sqrt(np.einsum("ni,nij,nj->n", error[seen], np.linalg.inv(covariance), error[seen]))
    refitted = float(np.count_nonzero(flags & Flag.REFITTED))
    return [
        absolute(f"{name}: markers flagged, of {len(flags)}", "", [float(np.count_nonzero(flags))]),
        absolute(f"{name}: markers refitted", "", [refitted]),
        at_most(5, absolute(f"{name}: worst unflagged or refitted", "of its sigmas", [float(sigmas.max())])),
    ]


def _beside(
    name: str, case: Case, images: list[Image], found: list[Detection], truth: Float, peers: dict[str, Peer]
) -> list[Figure]:
    """Our error and each peer's: better wherever the light is not flat, and there within 5 % of the strongest."""
    error_mpx = _rms_mpx([_usable(detection) for detection in found], truth)
    lines: list[Figure] = []
    for peer, search in peers.items():
        centres = [search(image) for image in images]
        usable = [_in_order(points, truth) for points in centres if points is not None and len(points)]
        if len(usable) < len(images):
            lines.append(skipped(f"{name}: {peer}", "it does not find the target"))
            continue
        ratio = side_by_side(f"{name}: error", "mpx RMS", peer, [error_mpx], [_rms_mpx(usable, truth)])
        lines.append(ratio_at_most(1.05 if case.flat and peer == STRONGEST else 1.0, ratio))
    return lines


def _noise(scene: Scene) -> Noise:
    return Noise(scene.read_DN**2 + 1 / 12, 1 / scene.electrons_per_DN)


def _tracked(images: list[Image], target: Target, before: Detection, noise: Noise) -> list[Detection]:
    found: list[Detection] = []
    for image in images:
        before = detect(image, target, before, noise)
        found.append(before)
    return found


def _usable(detection: Detection) -> Float:
    """Centres without a flag, and refitted ones; NaN for the others."""
    refitted = (detection.flags & Flag.REFITTED != 0) & (detection.flags & ~_SEEN == 0)
    return np.where(((detection.flags == 0) | refitted)[:, None], detection.centres_px, np.nan)


def _in_order(centres: Float, truth: Float) -> Float:
    """A peer's centres in the order of `truth`, NaN for what it does not find; it numbers them its own way."""
    away = np.linalg.norm(truth[:, None] - centres[None], axis=2)
    return np.where(away.min(axis=1)[:, None] < _FOUND_WITHIN_PX, centres[away.argmin(axis=1)], np.nan)


def _rms_mpx(centres_px: list[Float], truth_px: Float) -> float:
    return 1e3 * float(np.sqrt(np.nanmean((np.array(centres_px) - truth_px) ** 2)))
