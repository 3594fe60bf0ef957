"""A reference renderer for the tests: photographs of a marker grid with exact truth.

Shares no code with the program: the projection, the coverage of a pixel by a disc and the centres are written out
here again. Every disc is sampled on SUB x SUB cells per pixel; each cell's coverage is the exact area a straight line
cuts from it; then Gaussian PSF, pixel box, noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

SUB = 4
Float = NDArray[np.float64]


def make_even_light(u: Float, v: Float) -> Float:
    return np.ones(np.broadcast_shapes(u.shape, v.shape))


def make_shaded_light(u: Float, v: Float) -> Float:
    """Scene D of the 5 MP frame: +30 % along x, -20 % along y, 15 % vignetting."""
    x, y = (u - 1223.5) / 1223.5, (v - 1023.5) / 1023.5
    return (1 + 0.15 * x - 0.10 * y) * (1 - 0.075 * (x**2 + y**2))


@dataclass(frozen=True)
class Scene:
    """What is photographed. Angles in degrees; roll is counter-clockwise in the image; z is the distance in mm."""

    columns: int = 9
    rows: int = 6
    staggered: bool = False
    """Every second row is half a pitch to the right, and rows are half a pitch apart."""
    pitch_mm: float = 30.0
    diameters_mm: dict[int, float] = field(default_factory=dict[int, float])
    diameter_mm: float = 8.0
    size: tuple[int, int] = (2448, 2048)
    f_px: float = 8772.0
    distance_mm: float = 1000.0
    roll_deg: float = 0.0
    tilt_x_deg: float = 0.0
    tilt_y_deg: float = 0.0
    shift_mm: tuple[float, float] = (0.0, 0.0)
    k1: float = 0.0
    k2: float = 0.0
    disc_DN: float = 30.0
    ground_DN: float = 200.0
    psf_px: float = 1.0
    read_DN: float = 1.0
    electrons_per_DN: float = 40.0
    light: Callable[[Float, Float], Float] = make_even_light
    missing: tuple[int, ...] = ()
    clutter_mm: tuple[tuple[float, float, float], ...] = ()
    """Further discs: x, y, diameter in the object frame."""
    holes_mm: dict[int, float] = field(default_factory=dict[int, float])
    """Diameters of the holes in donut markers."""

    def discs_mm(self) -> Float:
        """Centre x, y and diameter of each marker (N, 3); marker 1 at the origin, X right, Y up."""
        return np.array(
            [
                (
                    (c + (r % 2) / 2 * self.staggered) * self.pitch_mm,
                    r * self.pitch_mm / (1 + self.staggered),
                    self.diameters_mm.get(r * self.columns + c + 1, self.diameter_mm),
                )
                for r in range(self.rows)
                for c in range(self.columns)
            ]
        )

    def pose(self) -> tuple[Float, Float]:
        """Rotation and translation of the object frame (Z towards the camera) into the camera frame (y down)."""
        a, b, c = np.radians([self.tilt_x_deg, self.tilt_y_deg, self.roll_deg])
        rx = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
        ry = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
        rz = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
        rotation = np.diag([1.0, -1.0, -1.0]) @ rz @ ry @ rx
        middle = np.array(
            [(self.columns - 1) * self.pitch_mm / 2, (self.rows - 1) * self.pitch_mm / (2 + 2 * self.staggered), 0]
        )
        towards = np.array([self.shift_mm[0], -self.shift_mm[1], self.distance_mm])
        return rotation, towards - rotation @ middle


def project(scene: Scene, plane_mm: Float) -> Float:
    """Points (K, 2) of the target's plane -> pixels (K, 2)."""
    rotation, translation = scene.pose()
    camera = np.column_stack([plane_mm, np.zeros(len(plane_mm))]) @ rotation.T + translation
    xy = camera[:, :2] / camera[:, 2:]
    r2 = (xy**2).sum(axis=1, keepdims=True)
    middle = (np.array(scene.size) - 1) / 2
    return xy * (1 + scene.k1 * r2 + scene.k2 * r2**2) * scene.f_px + middle


def back_project(scene: Scene, u: Float, v: Float) -> tuple[Float, Float]:
    """Pixels -> the target's plane, mm; the distortion is undone by fixed-point rounds."""
    middle = (np.array(scene.size) - 1) / 2
    xd, yd = (u - middle[0]) / scene.f_px, (v - middle[1]) / scene.f_px
    x, y = xd, yd
    for _ in range(30 if scene.k1 or scene.k2 else 0):
        r2 = x * x + y * y
        bend = 1 + scene.k1 * r2 + scene.k2 * r2**2
        x, before = xd / bend, x
        y = yd / bend
        if abs(x - before).max() < 1e-15:
            break
    rotation, translation = scene.pose()
    to_plane = np.linalg.inv(np.column_stack([rotation[:, :2], translation]))
    w = to_plane[2, 0] * x + to_plane[2, 1] * y + to_plane[2, 2]
    return tuple((to_plane[i, 0] * x + to_plane[i, 1] * y + to_plane[i, 2]) / w for i in (0, 1))  # pyright: ignore[reportReturnType]


def compute_true_centres_px(scene: Scene) -> Float:
    """Centroid of each marker's exact projected outline (N, 2)."""
    angle = np.arange(720) * (2 * np.pi / 720)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    discs = scene.discs_mm()[:, None]
    return _centroids(project(scene, (discs[..., :2] + discs[..., 2:] / 2 * circle).reshape(-1, 2)).reshape(-1, 720, 2))


def _centroids(polygons: Float) -> Float:
    """Of polygons (N, K, 2) -> (N, 2)."""
    origin = polygons.mean(axis=1)
    p = polygons - origin[:, None]
    q = np.roll(p, -1, axis=1)
    cross = p[..., 0] * q[..., 1] - q[..., 0] * p[..., 1]
    return origin + ((p + q) * cross[..., None]).sum(axis=1) / (3 * cross.sum(axis=1)[:, None])


def _coverage(level: Float) -> Float:
    """Part of each cell where `level` < 0, its boundary taken as a straight line (exact for one). The cells along
    the border of the array are not crossed by it."""
    inside = level < 0
    cover = inside.astype(np.float64)
    crossed = np.zeros_like(inside)  # the line runs between this cell's centre and one of its eight neighbours'
    rows = inside[:-1] != inside[1:]
    crossed[:-1] |= rows
    crossed[1:] |= rows
    columns = crossed[:, :-1] | crossed[:, 1:] | (inside[:, :-1] != inside[:, 1:])
    crossed[:, :-1] |= columns
    crossed[:, 1:] |= columns
    at = np.flatnonzero(crossed)
    flat, width = level.reshape(-1), level.shape[1]
    slopes = [abs(flat[at + next_] - flat[at - next_]) / 2 for next_ in (1, width)]
    wide = np.maximum(*slopes)
    narrow = np.maximum(np.minimum(*slopes), 1e-4 * wide)
    long, short, t = (wide + narrow) / 2, (wide - narrow) / 2, -flat[at]
    ramp = [np.maximum(t + offset, 0) ** 2 for offset in (long, short, -short, -long)]
    cover.reshape(-1)[at] = np.clip((ramp[0] - ramp[1] - ramp[2] + ramp[3]) / (2 * wide * narrow), 0, 1)
    return cover


@cache
def _blur(pixels: int, psf_px: float) -> Float:
    """What each of so many pixels in a line sees of the cells of all: the PSF and the pixel's box (pixels, cells)."""
    sigma = psf_px * SUB
    half = int(np.ceil(6 * sigma))
    kernel = cv2.getGaussianKernel(2 * half + 1, sigma)[:, 0]
    away = np.subtract.outer(np.arange(pixels * SUB), np.arange(pixels * SUB)) + half
    seen = np.where((away >= 0) & (away <= 2 * half), kernel[np.clip(away, 0, 2 * half)], 0.0)
    return seen.reshape(pixels, SUB, pixels * SUB).mean(axis=1)


def render(scene: Scene) -> Float:
    """The noise-free image, DN, shape (height, width)."""
    width, height = scene.size
    image = scene.ground_DN * scene.light(
        np.arange(width, dtype=np.float64)[None, :], np.arange(height, dtype=np.float64)[:, None]
    )
    image = np.array(np.broadcast_to(image, (height, width)))
    discs = [disc for number, disc in enumerate(scene.discs_mm(), 1) if number not in scene.missing]
    for disc in [*discs, *np.array(scene.clutter_mm).reshape(-1, 3)]:
        _draw(scene, image, disc, scene.disc_DN - scene.ground_DN)
    for number, diameter_mm in scene.holes_mm.items():
        _draw(scene, image, np.append(scene.discs_mm()[number - 1, :2], diameter_mm), scene.ground_DN - scene.disc_DN)
    return image


def _draw(scene: Scene, image: Float, disc: Float, contrast_DN: float) -> None:
    """Add what one disc takes from, or gives to, the blurred ground."""
    angle = np.arange(64) * (2 * np.pi / 64)
    outline = project(scene, disc[:2] + disc[2] / 2 * np.column_stack([np.cos(angle), np.sin(angle)]))
    margin = int(np.ceil(6 * scene.psf_px)) + 2
    low = np.floor(outline.min(axis=0)).astype(int) - margin
    high = np.ceil(outline.max(axis=0)).astype(int) + margin + 1
    # Nearly all of the margin is blur: the disc itself, and what it takes, ends a pixel beyond its outline.
    beyond = margin - 1
    own = [slice(beyond * SUB, (high[i] - low[i] - beyond) * SUB) for i in (0, 1)]
    u, v = (low[i] - 0.5 + (np.arange(own[i].start, own[i].stop) + 0.5) / SUB for i in (0, 1))
    u, v = u[None, :], v[:, None]
    x, y = back_project(scene, u, v)
    cover = _coverage(np.hypot(x - disc[0], y - disc[1]) - disc[2] / 2)
    radiance = scene.light(u, v) * contrast_DN * cover
    columns, rows = (_blur(int(high[i] - low[i]), scene.psf_px)[:, own[i]] for i in (0, 1))
    pixels = rows @ radiance @ columns.T
    top, left = max(low[1], 0), max(low[0], 0)
    bottom, right = min(high[1], image.shape[0]), min(high[0], image.shape[1])
    if top < bottom and left < right:
        image[top:bottom, left:right] += pixels[top - low[1] : bottom - low[1], left - low[0] : right - low[0]]


def photograph(
    scene: Scene, clean: Float, seed: int, dtype: type[np.uint8] | type[np.uint16] = np.uint8
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """`clean` with read and shot noise, rounded and clipped."""
    rng = np.random.default_rng(seed)
    sigma = np.sqrt(scene.read_DN**2 + np.maximum(clean, 0) / scene.electrons_per_DN)
    noisy = rng.standard_normal(clean.shape)
    noisy *= sigma
    noisy += clean
    return np.clip(np.rint(noisy, out=noisy), 0, np.iinfo(dtype).max, out=noisy).astype(dtype)  # pyright: ignore[reportReturnType] - of one of the two
