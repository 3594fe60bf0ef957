"""True optics -> image of the markers: exact coverage, Gaussian blur, uneven light, sensor noise, eight bits.

Each projected disc is a fine polygon whose exact area in every cell of a grid four times finer than the pixels is
summed; Gaussian and pixel box then act on that grid. The centroid survives to better than 1e-5 px, so the image
adds no errors of its own to those of a marker finder. Signals are in DN.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermostand.drivers.sim.physics.optics import HEIGHT_px, Optics, WIDTH_px, compute_outlines_px

SUBCELLS = 4  # cells per pixel and axis
BLUR_REACH = 6.0  # the Gaussian is followed this many sigma outwards
EDGE_CELLS = 0.9  # longest outline edge in cells: it then crosses at most one line of either direction
FLAP_SHUT = 0.05  # openness below which no light passes
FLAP_CLEAR = 0.95  # openness from which nothing shades
NOISE_ROWS = 64  # rows handled at once, so that they stay in the cache


@dataclass(frozen=True)
class SceneSpec:
    """Light, target print, lens blur and sensor.

    paper_DN and disc_DN: in the image centre at nominal_exposure_s, 0 dB and an open flap, black level included.
    light_slope: relative gain of light from the left to the right and from the top to the bottom edge. vignetting:
    relative loss in the corners. shot_e_per_DN and read_noise_DN hold at 0 dB; gain lifts both noises.
    """

    paper_DN: float = 200.0
    disc_DN: float = 30.0
    black_DN: float = 3.0
    nominal_exposure_s: float = 0.1
    blur_px: float = 1.0
    light_slope: tuple[float, float] = (0.08, -0.05)
    vignetting: float = 0.06
    shot_e_per_DN: float = 40.0
    read_noise_DN: float = 1.0


class SimulatedScene:
    """Renders the target; holds only what the spec fixes, so frames do not depend on each other."""

    def __init__(self, spec: SceneSpec, seed: int) -> None:
        self._spec = spec
        self._seed = seed
        self._light = _light(spec, 0)

    def render(
        self,
        optics: Optics,
        time_ns: int,
        exposure_s: float,
        gain_dB: float,
        flap_open: float,
        rows: int = HEIGHT_px,
    ) -> NDArray[np.uint8]:
        """(rows, 2448) frame, the upper part of the sensor's 2048 rows; its noise depends on the seed and `time_ns`
        only."""
        image = self.noise_free(optics, exposure_s, gain_dB, flap_open, rows)
        noise = np.random.Generator(np.random.SFC64(np.random.SeedSequence((self._seed, time_ns))))
        gain = _gain(gain_dB)
        read_variance = np.float32((gain * self._spec.read_noise_DN) ** 2)
        shot_per_DN = np.float32(gain / self._spec.shot_e_per_DN)
        frame = np.empty(image.shape, dtype=np.uint8)
        draw = np.empty((NOISE_ROWS, image.shape[1]), dtype=np.float32)
        for top in range(0, rows, NOISE_ROWS):
            signal = image[top : top + NOISE_ROWS]
            noise.standard_normal(dtype=np.float32, out=draw)
            part = draw[: len(signal)]
            part *= np.sqrt((signal - np.float32(self._spec.black_DN)) * shot_per_DN + read_variance)
            part += signal
            part += np.float32(0.5)  # with the cut of astype: rounding
            np.clip(part, 0.0, 255.0, out=part)
            frame[top : top + NOISE_ROWS] = part
        return frame

    def noise_free(
        self, optics: Optics, exposure_s: float, gain_dB: float, flap_open: float, rows: int = HEIGHT_px
    ) -> NDArray[np.float32]:
        """The upper rows of the image before noise, rounding and saturation, DN, black level included."""
        spec = self._spec
        scale = exposure_s / spec.nominal_exposure_s * _gain(gain_dB)
        if flap_open < FLAP_SHUT:
            return np.full((rows, WIDTH_px), spec.black_DN, dtype=np.float32)
        if len(self._light) < rows:
            self._light = _light(spec, rows)
        image = self._light[:rows] * _shadow(flap_open, scale * (spec.paper_DN - spec.black_DN))[:rows]
        darkening = np.float32(1.0 - (spec.disc_DN - spec.black_DN) / (spec.paper_DN - spec.black_DN))
        for left, top, coverage in compute_disc_coverages(optics, spec.blur_px, rows):
            _dim(image, left, top, 1.0 - darkening * coverage)
        image += np.float32(spec.black_DN)
        return image


Picture = Callable[[Optics, int, float, float, float, int], NDArray[np.uint8]]


def make_still(render: Picture) -> Picture:
    """The same as `Scene.render`, rendered once and shown until another exposure, gain, flap or region is asked for."""
    kept: dict[tuple[float, float, float, int], NDArray[np.uint8]] = {}

    def shown(
        optics: Optics, time_ns: int, exposure_s: float, gain_dB: float, flap_open: float, rows: int
    ) -> NDArray[np.uint8]:
        key = exposure_s, gain_dB, flap_open, rows
        if key not in kept:
            kept.clear()
            kept[key] = render(optics, time_ns, *key)
        return kept[key]

    return shown


def compute_disc_coverages(
    optics: Optics, blur_px: float, rows: int = HEIGHT_px
) -> list[tuple[int, int, NDArray[np.float32]]]:
    """Per marker that reaches into the upper `rows` (left, top, coverage): its blurred disc, 0..1 per pixel, and the
    pixel of the array's corner.

    Arrays are not cut at the image's border; the sum of a coverage is the disc's area in px^2.
    """
    margin_px = math.ceil(BLUR_REACH * blur_px) + 1
    least, most = _boxes(compute_outlines_px(optics, 16))
    widest_px = (most - least).max()
    if least[:, 1].min() - 0.1 * widest_px - margin_px > rows:  # these outlines are 2 % of a radius too small at most
        return []
    outlines = compute_outlines_px(optics, math.ceil(math.pi * widest_px * 1.1 * SUBCELLS / EDGE_CELLS))
    least, most = _boxes(outlines)
    corners = np.floor(least).astype(int) - margin_px
    width, height = (np.ceil(most).astype(int) + margin_px + 1 - corners).max(axis=0)
    across, down = _blur_matrix(int(width), blur_px), _blur_matrix(int(height), blur_px)
    discs: list[tuple[int, int, NDArray[np.float32]]] = []
    for outline, (left, top) in zip(outlines, corners, strict=True):
        if top >= rows:
            continue
        cells = (outline - (left, top) + 0.5) * SUBCELLS
        fine = compute_polygon_coverage(cells, int(width) * SUBCELLS, int(height) * SUBCELLS).astype(np.float32)
        coverage = np.empty((int(height), int(width)), dtype=np.float32)
        np.matmul(down @ fine, across.T, out=coverage)
        discs.append((int(left), int(top), coverage))
    return discs


def _boxes(outlines: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the smallest and the largest x and y of outlines (n, points, 2), (n, 2) each."""
    x, y = np.ascontiguousarray(outlines[..., 0]), np.ascontiguousarray(outlines[..., 1])  # ten times as fast as pairs
    return np.stack((x.min(axis=1), y.min(axis=1)), axis=-1), np.stack((x.max(axis=1), y.max(axis=1)), axis=-1)


def compute_polygon_coverage(vertices: NDArray[np.float64], width: int, height: int) -> NDArray[np.float64]:
    """(height, width) exact area of a polygon in each unit cell; cell [row, column] spans column .. column + 1.

    Vertices (n, 2) are (x, y) inside the grid; edges must be shorter than a cell. By Green's theorem each piece of edge
    within one cell adds its height times its distance to the cell's right side there, and its full height to all cells
    to the right, which the running sum along the row supplies.
    """
    step = np.roll(vertices, -1, axis=0) - vertices
    line = np.floor(np.maximum(vertices, vertices + step))  # the only grid lines an edge can cross
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = np.nan_to_num((line - vertices) / step, nan=0.0, posinf=0.0, neginf=0.0)
    cuts = np.zeros((len(vertices), 4))
    cuts[:, 1:3] = np.sort(np.clip(crossing, 0.0, 1.0), axis=1)
    cuts[:, 3] = 1.0
    middle = vertices[:, None, :] + step[:, None, :] * ((cuts[:, 1:] + cuts[:, :-1]) / 2)[..., None]
    rise = step[:, None, 1] * np.diff(cuts, axis=1)
    column, row = np.floor(middle[..., 0]), np.floor(middle[..., 1])
    to_next = rise * (middle[..., 0] - column)
    index = (row * (width + 1) + column).astype(np.intp).ravel()
    area = np.bincount(index, (rise - to_next).ravel(), height * (width + 1))
    area[1:] += np.bincount(index, to_next.ravel(), height * (width + 1))[:-1]
    inside = area.reshape(height, width + 1)
    np.add.accumulate(inside, axis=1, out=inside)
    return np.abs(inside[:, :-1], out=inside[:, :-1])


@functools.lru_cache(maxsize=8)
def _blur_matrix(pixels: int, blur_px: float) -> NDArray[np.float32]:
    """(pixels, pixels * SUBCELLS): Gaussian and pixel box acting on cell areas, one axis.

    A cell's area is already the disc seen through a box one cell wide; that width is taken out of the Gaussian.
    """
    sigma_px = math.sqrt(blur_px**2 - 1.0 / (12.0 * SUBCELLS**2))
    offset_px = (np.arange(-pixels * SUBCELLS, pixels * SUBCELLS) + 0.5) / SUBCELLS  # pixel's edge minus cell's centre
    below = np.array([0.5 * (1.0 + math.erf(offset / sigma_px / math.sqrt(2.0))) for offset in offset_px])
    left_edge = np.arange(pixels)[:, None] * SUBCELLS - np.arange(pixels * SUBCELLS) + pixels * SUBCELLS - 1
    return ((below[left_edge + SUBCELLS] - below[left_edge]) / SUBCELLS).astype(np.float32)


def _light(spec: SceneSpec, rows: int) -> NDArray[np.float32]:
    """Relative light on the image's upper rows, 1 in the centre: a plane times a radial loss."""
    x = (np.arange(WIDTH_px) - (WIDTH_px - 1) / 2) / WIDTH_px
    y = ((np.arange(rows) - (HEIGHT_px - 1) / 2) / HEIGHT_px)[:, None]
    corner_squared = (WIDTH_px**2 + HEIGHT_px**2) / (4.0 * WIDTH_px**2)
    radius_squared = (x**2 + (y * HEIGHT_px / WIDTH_px) ** 2) / corner_squared
    light = (1.0 + spec.light_slope[0] * x + spec.light_slope[1] * y) * (1.0 - spec.vignetting * radius_squared)
    return light.astype(np.float32)


def _shadow(flap_open: float, signal_DN: float) -> NDArray[np.float32]:
    """(rows, 1) signal behind a partly open flap: it slides away from the top, its blurred edge shades linearly."""
    row_share = (np.arange(HEIGHT_px) / (HEIGHT_px - 1))[:, None]
    return (signal_DN * np.clip(2.0 * flap_open / FLAP_CLEAR - row_share, 0.0, 1.0)).astype(np.float32)


def _gain(gain_dB: float) -> float:
    """Amplification of the signal; GigE Vision's dB are of amplitude."""
    return 10.0 ** (gain_dB / 20.0)


def _dim(image: NDArray[np.float32], left: int, top: int, factor: NDArray[np.float32]) -> None:
    """Multiply what of `factor`, laid with its corner on (left, top), falls on the image."""
    row, column = max(0, top), max(0, left)
    end_row, end_column = min(image.shape[0], top + factor.shape[0]), min(image.shape[1], left + factor.shape[1])
    if row < end_row and column < end_column:
        image[row:end_row, column:end_column] *= factor[row - top : end_row - top, column - left : end_column - left]
