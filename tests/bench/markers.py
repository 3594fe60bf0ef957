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
    compare,
    make_absolute,
    make_skipped,
    measure_in_turns,
    measure_processor_ms,
    report_progress,
    set_upper_goal,
    set_upper_ratio_goal,
)
from tests.bench.marker_peers import COMMON, STRONGEST, Float, Image, Peer, opencv_peers
from tests.compensation.renderer import Scene, compute_true_centres_px, make_shaded_light, photograph, project, render
from thermostand.markers.detection import Detection, Flag, Noise, detect
from thermostand.markers.eccentricity import compute_disc_centres_px
from thermostand.markers.target import Target, load_target
from thermostand.stand.config.stand_config import find_packaged

ROUNDS = 5
FRAMES = 4

_FOUND_WITHIN_PX = 60
_SEEN = np.uint8(Flag.REFITTED | Flag.SATURATED)


def shade_strongly(u: Float, v: Float) -> Float:
    """80 % along x, -50 % along y."""
    return 1 + 0.4 * (u - 1223.5) / 1223.5 - 0.25 * (v - 1023.5) / 1023.5


def keep_image(clean: Float, truth: Float) -> Float:
    return clean


def add_scattered_light(clean: Float, truth: Float) -> Float:
    """Light on top of everything: 25 DN, 200 px wide, in the middle."""
    v, u = np.ogrid[:2048, :2448]
    return clean + 25 * np.exp(-((u - 1223.5) ** 2 + (v - 1023.5) ** 2) / (2 * 200.0**2))


def add_glare(clean: Float, truth: Float) -> Float:
    """Three saturating spots on markers' outlines."""
    v, u = np.ogrid[:2048, :2448]
    spots = zip(truth[[9, 26, 43]], (0.3, 2.5, 4.4), (8.0, 14.0, 22.0), strict=True)
    for (x, y), angle, width in spots:
        x, y = x + 35 * np.cos(angle), y + 35 * np.sin(angle)
        clean = clean + 500 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * width**2))
    return clean


def occlude(clean: Float, truth: Float) -> Float:
    """A sheet of 90 DN over a quarter of each disc of the first column."""
    covered = 0.5 - 0.5 * np.tanh(0.85 * (np.arange(2448) - (truth[0, 0] - 14)))
    return clean + (90 - clean) * covered


@dataclass(frozen=True, slots=True)
class Case:
    """A scene, its Cramer-Rao limit in mpx, and what lies over the picture. flat: under perfectly even light, where a
    blob detector with many thresholds is as good as the optimum; nobody is that much better."""

    scene: Scene
    limit_mpx: float
    over: Callable[[Float, Float], Float] = keep_image
    flat: bool = False


CASES = {
    "A even light": Case(Scene(), 2.21, flat=True),
    "B sharp, psf 0.8": Case(Scene(psf_px=0.8), 1.97, flat=True),
    "C psf 1.5, read 2": Case(Scene(psf_px=1.5, read_DN=2), 3.78, flat=True),
    "D shaded": Case(Scene(light=make_shaded_light), 2.21),
    "D2 strongly shaded": Case(Scene(light=shade_strongly, disc_DN=20, ground_DN=150), 2.61),
    "E tilt 30": Case(Scene(tilt_y_deg=30, tilt_x_deg=5, roll_deg=20, distance_mm=1040), 2.47),
    "F tilt 45": Case(Scene(tilt_y_deg=45, distance_mm=1040), 2.76),
    "G defocus, psf 3": Case(Scene(psf_px=3), 4.38),
    "H glare": Case(Scene(), 2.21, add_glare),
    "I occluder": Case(Scene(), 2.21, occlude),
    "J distortion, tilt 20": Case(Scene(k1=-0.15, k2=0.1, tilt_y_deg=20), 2.21),
    "K scattered light": Case(Scene(), 2.21, add_scattered_light),
}


def figures(directory: Path) -> list[Figure]:
    """ms for a first and for a tracked frame, then the errors of each scene, ours and the peers'."""
    cv2.setNumThreads(1)
    target = load_target(find_packaged("targets", "paper-9x6"))
    peers = opencv_peers(target)
    lines: list[Figure] = []
    for name, case in CASES.items():
        report_progress(f"markers, scene {name}")
        truth, bare = compute_true_centres_px(case.scene), render(case.scene)
        clean = case.over(bare, truth)
        images = [photograph(case.scene, clean, seed) for seed in range(FRAMES)]
        before = detect(photograph(case.scene, bare, FRAMES), target, noise=_make_noise(case.scene))
        if name.startswith("A"):
            lines += _measure_times(images, target, peers)
        found = _track(images, target, before, _make_noise(case.scene))
        if case.over in (add_glare, occlude):
            lines += _score_flags(name, found, truth)
        else:
            lines += _compare_with_limit(name, case, clean, found, truth, target)
            lines.append(_score_discs(name, case, found, target))
        lines += _compare_with_peers(name, case, images, found, truth, peers)
    return lines


def _measure_times(images: list[Image], target: Target, peers: dict[str, Peer]) -> list[Figure]:
    previous = detect(images[0], target)
    lines: list[Figure] = []
    for what, before, goal_ms in (("first", None, 15), ("tracked", previous, 3)):
        own_ms = [
            measure_processor_ms(lambda before=before: detect(images[1], target, before)) for _ in range(2 * ROUNDS + 1)
        ]
        lines.append(set_upper_goal(goal_ms, make_absolute(f"markers, {what} 5 MP frame, one core", "ms", own_ms[1:])))
        for peer, search in peers.items():
            own, other = measure_in_turns(
                lambda before=before: measure_processor_ms(lambda: detect(images[1], target, before)),
                lambda search=search: measure_processor_ms(lambda: search(images[1])),
                ROUNDS,
            )
            comparison = compare(f"markers, {what} 5 MP frame, one core", "ms", peer, own, other)
            lines.append(set_upper_ratio_goal(0.1, comparison) if peer == COMMON and before is None else comparison)
    return lines


def _compare_with_limit(
    name: str, case: Case, clean: Float, found: list[Detection], truth: Float, target: Target
) -> list[Figure]:
    """Error against the limit, bias, and the honesty of the covariance."""
    error_mpx = _rms_mpx([_select_usable(detection) for detection in found], truth)
    sigma_mpx = 1e3 * float(np.sqrt(np.nanmean([np.diagonal(one.covariance_px2, axis1=1, axis2=2) for one in found])))
    # 12 bits more than the noisy frames have: what is left is the model's.
    fine = detect(np.round(clean * 200).astype(np.uint16), target, noise=Noise(1.0, 1 / 40))
    limit = compare(f"{name}: error", "mpx RMS", "Cramer-Rao limit", [error_mpx], [case.limit_mpx])
    return [
        set_upper_goal(1.15 * case.limit_mpx, limit),
        set_upper_goal(0.1, make_absolute(f"{name}: bias", "mpx RMS", [_rms_mpx([fine.centres_px], truth)])),
        set_upper_goal(
            0.1, make_absolute(f"{name}: predicted over actual sigma, off 1", "", [abs(sigma_mpx / error_mpx - 1)])
        ),
    ]


def _score_discs(name: str, case: Case, found: list[Detection], target: Target) -> Figure:
    """Error of the images of the discs' own centres against the limit of the outlines'."""
    middles = project(case.scene, case.scene.discs_mm()[:, :2])
    error_mpx = _rms_mpx([compute_disc_centres_px(detection, target) for detection in found], middles)
    limit = compare(f"{name}: discs' centres", "mpx RMS", "Cramer-Rao limit", [error_mpx], [case.limit_mpx])
    return set_upper_ratio_goal(2.5 if case.scene.k1 else 1.2, limit)


def _score_flags(name: str, found: list[Detection], truth: Float) -> list[Figure]:
    """How many markers are flagged and refitted, and how far one is off that is reported to be right."""
    flags = np.concatenate([detection.flags for detection in found])
    error = np.concatenate([_select_usable(detection) - truth for detection in found])
    seen = np.isfinite(error[:, 0])
    covariance = np.concatenate([detection.covariance_px2 for detection in found])[seen]
    sigmas = np.sqrt(np.einsum("ni,nij,nj->n", error[seen], np.linalg.inv(covariance), error[seen]))
    refitted = float(np.count_nonzero(flags & Flag.REFITTED))
    return [
        make_absolute(f"{name}: markers flagged, of {len(flags)}", "", [float(np.count_nonzero(flags))]),
        make_absolute(f"{name}: markers refitted", "", [refitted]),
        set_upper_goal(
            5, make_absolute(f"{name}: worst unflagged or refitted", "of its sigmas", [float(sigmas.max())])
        ),
    ]


def _compare_with_peers(
    name: str, case: Case, images: list[Image], found: list[Detection], truth: Float, peers: dict[str, Peer]
) -> list[Figure]:
    """Our error and each peer's: better wherever the light is not flat, and there within 5 % of the strongest."""
    error_mpx = _rms_mpx([_select_usable(detection) for detection in found], truth)
    lines: list[Figure] = []
    for peer, search in peers.items():
        centres = [search(image) for image in images]
        usable = [_order_like(points, truth) for points in centres if points is not None and len(points)]
        if len(usable) < len(images):
            lines.append(make_skipped(f"{name}: {peer}", "it does not find the target"))
            continue
        ratio = compare(f"{name}: error", "mpx RMS", peer, [error_mpx], [_rms_mpx(usable, truth)])
        lines.append(set_upper_ratio_goal(1.05 if case.flat and peer == STRONGEST else 1.0, ratio))
    return lines


def _make_noise(scene: Scene) -> Noise:
    return Noise(scene.read_DN**2 + 1 / 12, 1 / scene.electrons_per_DN)


def _track(images: list[Image], target: Target, before: Detection, noise: Noise) -> list[Detection]:
    found: list[Detection] = []
    for image in images:
        before = detect(image, target, before, noise)
        found.append(before)
    return found


def _select_usable(detection: Detection) -> Float:
    """Centres without a flag, and refitted ones; NaN for the others."""
    refitted = (detection.flags & Flag.REFITTED != 0) & (detection.flags & ~_SEEN == 0)
    return np.where(((detection.flags == 0) | refitted)[:, None], detection.centres_px, np.nan)


def _order_like(centres: Float, truth: Float) -> Float:
    """A peer's centres in the order of `truth`, NaN for what it does not find; it numbers them its own way."""
    away = np.linalg.norm(truth[:, None] - centres[None], axis=2)
    return np.where(away.min(axis=1)[:, None] < _FOUND_WITHIN_PX, centres[away.argmin(axis=1)], np.nan)


def _rms_mpx(centres_px: list[Float], truth_px: Float) -> float:
    return 1e3 * float(np.sqrt(np.nanmean((np.array(centres_px) - truth_px) ** 2)))
