"""Rendered scenes in random poses, and whether the markers that were found in them are each in their place.

Thirteen scenes of the paper's target at 5 MP, and seven other targets. "Wrong" is an answer that puts at least one
marker in another's place.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.compensation.renderer import Float, Scene, compute_true_centres_px, project
from thermostand.markers.candidate_search import find_candidates, iterate_disc_sizes_px
from thermostand.markers.grid_identification import DetectionError, identify
from thermostand.markers.target import Target

CLUTTER_DISCS = 20
NEAR_px = 4.0
"""A centre this close to the true one is that marker: markers are 70 px across and 260 px apart."""

Image = NDArray[np.uint8] | NDArray[np.uint16]


def make_uneven_light(u: Float, v: Float) -> Float:
    """+-90 % along x and +-50 % along y from corner to corner of the 5 MP frame, and vignetting."""
    x, y = (u - 1223.5) / 1223.5, (v - 1023.5) / 1023.5
    return (1 + 0.45 * x - 0.25 * y) * (1 - 0.075 * (x**2 + y**2))


SCENES: dict[str, Scene] = {
    "frontal": Scene(),
    "roll 20": Scene(roll_deg=20),
    "roll 45": Scene(roll_deg=45),
    "tilt 30 about x": Scene(tilt_x_deg=30),
    "tilt 30 about y": Scene(tilt_y_deg=30),
    "tilt 45 about x": Scene(tilt_x_deg=45),
    "tilt 45 about y": Scene(tilt_y_deg=45),
    "tilt 45, roll 20": Scene(tilt_y_deg=45, roll_deg=20),
    "wide field, distortion": Scene(f_px=2600, k1=-0.25),
    "uneven light": Scene(light=make_uneven_light),
    "low contrast": Scene(disc_DN=90, ground_DN=130),
    "one marker missing": Scene(missing=(1,)),
    "dark disc clutter": Scene(),
}


def _target(columns: int, rows: int, diameter_mm: float = 5.0, **others: Any) -> Target:
    return Target(name="t", columns=columns, rows=rows, pitch_mm=10.0, diameter_mm=diameter_mm, **others)


def _of(target: Target, **others: Any) -> Scene:
    size = {"columns": target.columns, "rows": target.rows, "staggered": target.layout == "staggered"}
    return Scene(**size, pitch_mm=target.pitch_mm, diameter_mm=target.diameter_mm, **others)


def _targets() -> dict[str, tuple[Target, Scene]]:
    light, staggered = _target(9, 6, polarity="light"), _target(4, 11, layout="staggered")
    quarter = {"size": (1224, 1024), "f_px": 4386.0}
    webcam, slim = {"size": (640, 480), "f_px": 700.0}, _target(9, 6, diameter_mm=1.5)
    return {
        "light on dark": (light, _of(light, **quarter, disc_DN=200, ground_DN=40, roll_deg=10, tilt_x_deg=20)),
        "staggered 4x11": (staggered, _of(staggered, **quarter, roll_deg=160, tilt_y_deg=20)),
        "20x14": (_target(20, 14), _of(_target(20, 14), roll_deg=7, tilt_y_deg=25)),
        "40x30": (_target(40, 30), _of(_target(40, 30), roll_deg=7, tilt_y_deg=25)),
        "40x30, wide field": (_target(40, 30), _of(_target(40, 30), f_px=2600, k1=-0.25)),
        "webcam, 8 px discs": (slim, _of(slim, **webcam, roll_deg=10, tilt_x_deg=20)),
        "webcam, 20x14": (_target(20, 14), _of(_target(20, 14), **webcam, roll_deg=3, tilt_x_deg=10)),
    }


TARGETS = _targets()


def draw_pose(name: str, seed: int, poses: dict[str, Scene] = SCENES) -> Scene:
    """The scene in a random pose near its nominal one, the whole target in the frame."""
    rng = np.random.default_rng([seed, sorted(poses).index(name)])
    base = poses[name]
    turned = replace(
        base,
        roll_deg=base.roll_deg + rng.uniform(-4, 4),
        tilt_x_deg=base.tilt_x_deg + rng.uniform(-4, 4),
        tilt_y_deg=base.tilt_y_deg + rng.uniform(-4, 4),
    )
    framed = _fit_in_frame(turned, rng.uniform(1.03, 1.3), rng.uniform(-1, 1, 2))
    if base.missing:
        return replace(framed, missing=(int(rng.integers(1, 55)),))
    if "clutter" in name:
        return replace(framed, clutter_mm=_clutter_mm(framed, rng))
    return framed


def _fit_in_frame(scene: Scene, margin: float, shift: Float) -> Scene:
    """At `margin` times the least distance that has every disc in the frame, moved within half of what is left."""
    distance_mm = scene.f_px * 50.0 / scene.size[0]
    while not _fits(replace(scene, distance_mm=distance_mm)):
        distance_mm *= 1.02
    placed = replace(scene, distance_mm=distance_mm * margin)
    free_mm = (margin - 1) / 2 * distance_mm * np.array(scene.size) / scene.f_px
    for part in (0.5, 0.25, 0.0):
        moved = replace(placed, shift_mm=tuple(part * shift * free_mm))
        if _fits(moved):
            return moved
    raise ValueError("the target does not fit the frame")


def _fits(scene: Scene) -> bool:
    angle = np.arange(16) * (2 * np.pi / 16)
    discs = scene.discs_mm()
    outlines = discs[:, None, :2] + discs[:, None, 2:] / 2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    px = project(scene, outlines.reshape(-1, 2))
    return bool((px.min(axis=0) > 8).all() and (px.max(axis=0) < np.array(scene.size) - 9).all())


def _clutter_mm(scene: Scene, rng: np.random.Generator) -> tuple[tuple[float, float, float], ...]:
    """Discs of the markers' size strewn over and around the target; none touches another."""
    placed: Float = scene.discs_mm()
    count = len(placed)
    low, high = placed[:, :2].min(axis=0) - 40, placed[:, :2].max(axis=0) + 40
    while len(placed) < count + CLUTTER_DISCS:
        place = rng.uniform(low, high)
        if np.linalg.norm(placed[:, :2] - place, axis=1).min() > 1.3 * scene.diameter_mm:
            placed = np.vstack([placed, [*place, scene.diameter_mm]])
    return tuple((float(x), float(y), float(size)) for x, y, size in placed[count:])


def find_own_centres(image: Image, target: Target) -> Float | None:
    """The first stage's centres of the identified markers."""
    for size_px in iterate_disc_sizes_px(target, image.shape):
        candidates = find_candidates(image, target, size_px)
        try:
            found = identify(candidates, target).candidate
        except DetectionError:
            continue
        return np.where(found[:, None] >= 0, candidates.centres_px[found], np.nan)
    return None


def judge(centres_px: Float | None, scene: Scene, own_order: bool) -> str:
    """`found` when every visible marker is there and in its place, `wrong` when one is in another's, else `refused`."""
    if centres_px is None or len(centres_px) != len(scene.discs_mm()):
        return "refused"
    truth = compute_true_centres_px(scene)
    orders = [np.arange(len(truth))] if own_order else _orders(scene)
    off = min((np.linalg.norm(centres_px - truth[order], axis=1) for order in orders), key=lambda d: np.nansum(d))
    if np.nanmax(off) > NEAR_px:
        return "wrong"
    gaps = tuple(int(number) for number in np.flatnonzero(np.isnan(off)) + 1)
    return "found" if gaps == scene.missing else "refused"


def _orders(scene: Scene) -> list[NDArray[np.intp]]:
    """The target's markers read from any corner, along rows: a peer may begin where it likes."""
    grid = np.arange(scene.columns * scene.rows).reshape(scene.rows, scene.columns)
    return [turned.ravel() for turned in (grid, grid[::-1], grid[:, ::-1], grid[::-1, ::-1])]
