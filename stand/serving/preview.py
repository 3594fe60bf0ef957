"""What the page shows of a frame: a picture of half its size, the markers in it and how far each has moved since the
reference, and what helps to set a camera up. Arrays in, values out; the first frame of a target takes the longest.

Drift is that of the camera, so it is measured in frames in which nothing else moves: those of the roles in DRIFT_ROLES
and between runs. The reference is the last frame that was asked for as one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from thermostand.foundation.errors import DetectionError
from thermostand.markers.detection import Detection, convert_to_grey, detect
from thermostand.markers.edge_model import SIGMA
from thermostand.markers.homography import compute_roll_deg, project
from thermostand.markers.target import Target
from thermostand.stand.serving.shot import DRIFT_ROLES, FrameShot, Image

_JPEG_QUALITY = 80  # for the page only: the markers are found in the frame itself
_BINS = 64  # of the page's histogram
_EDGE_10_90 = 2.5631  # from 10 to 90 % of a Gaussian edge, in its standard deviations
_CORNER = np.array([(0, 0), (1, 0), (0, 1)])  # mm
_NEARLY_SQUARE = 0.9995  # foreshortening that noise and pixels that are not quite square can make, too

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Setup:
    """Values for setting up. histogram: shares of the pixels in 64 equal parts of the range. saturated: share of pixels
    at its end; dark: at its beginning. The rest is None without markers. edge_px: mean width of the markers' edges, 10
    to 90 %. tilt_deg: of the target against the image, from its foreshortening, None when that is too small to tell.
    keystone_x_percent: by how much larger the right end of the target appears than the left one, keystone_y_percent:
    the lower than the upper; 0 when camera and target face each other. roll_deg: of the target in the image."""

    histogram: tuple[float, ...]
    saturated: float
    dark: float
    edge_px: float | None = None
    contrast_DN: float | None = None
    tilt_deg: float | None = None
    keystone_x_percent: float | None = None
    keystone_y_percent: float | None = None
    roll_deg: float | None = None


@dataclass(frozen=True, slots=True)
class Preview:
    """width, height: of the whole frame, px, in which all else is given. markers: number, x, y, and its drift (dx, dy)
    or None. mean_px: length of the mean drift; mean_dx, mean_dy: that; worst_px: the largest drift, of marker `worst`.
    reference_ns: the time of the frame that drift is measured against. trouble: why there are no markers."""

    camera: str
    time_ns: int
    width: int
    height: int
    role: str
    setup: Setup
    markers: tuple[tuple[int, float, float, float | None, float | None], ...] = ()
    expected: int = 0
    mean_px: float | None = None
    mean_dx: float | None = None
    mean_dy: float | None = None
    worst_px: float | None = None
    worst: int | None = None
    reference_ns: int | None = None
    trouble: str = ""
    jpeg: bytes = field(default=b"", repr=False)


class Previewer:
    """Remembers, of each camera, the frame before and the reference."""

    def __init__(self, target: Target) -> None:
        self._target = target
        self._before: dict[str, Detection] = {}
        self._reference: dict[str, tuple[int, Float]] = {}

    def look(self, shot: FrameShot) -> Preview:
        """Return what there is to see in a frame; one without the target has no markers and says why."""
        grey = convert_to_grey(shot.image)
        height, width = grey.shape
        found, trouble = None, ""
        try:
            found = detect(grey, self._target, self._before.get(shot.camera))
            self._before[shot.camera] = found
        except DetectionError as error:
            trouble = str(error)
        jpeg = encode_half_jpeg(shot.image)
        common = (shot.camera, shot.time_ns, width, height, shot.role)
        if found is None:
            return Preview(*common, measure_setup(grey, None, self._target), trouble=trouble, jpeg=jpeg)
        drift = self._drift(shot, found)
        seen = np.isfinite(found.centres_px[:, 0])
        still = np.isfinite(drift[:, 0])
        size = np.hypot(drift[:, 0], drift[:, 1])
        mean = drift[still].mean(axis=0) if still.any() else None
        reference = self._reference.get(shot.camera)
        return Preview(
            *common,
            measure_setup(grey, found, self._target),
            tuple(_make_marker(int(index), found.centres_px[index], drift[index]) for index in np.flatnonzero(seen)),
            self._target.count,
            None if mean is None else float(np.hypot(*mean)),
            None if mean is None else float(mean[0]),
            None if mean is None else float(mean[1]),
            None if mean is None else float(np.nanmax(size)),
            None if mean is None else int(np.nanargmax(size)) + 1,
            reference[0] if mean is not None and reference is not None else None,
            jpeg=jpeg,
        )

    def _drift(self, shot: FrameShot, found: Detection) -> Float:
        """The drift of each marker, px; NaN where it is unknown."""
        if shot.role not in DRIFT_ROLES:
            return np.full_like(found.centres_px, np.nan)
        if shot.as_reference or shot.camera not in self._reference:
            self._reference[shot.camera] = (shot.time_ns, found.centres_px)
        return found.centres_px - self._reference[shot.camera][1]


def _make_marker(index: int, centre: Float, drift: Float) -> tuple[int, float, float, float | None, float | None]:
    x, y, dx, dy = (None if math.isnan(value) else round(value, 4) for value in (*centre.tolist(), *drift.tolist()))
    return index + 1, x or 0.0, y or 0.0, dx, dy


def encode_half_jpeg(image: Image) -> bytes:
    """A JPEG of half the width and height; b"" when the picture cannot be encoded."""
    eight = (image >> 8).astype(np.uint8) if image.dtype == np.uint16 else image
    height, width = eight.shape[:2]
    half = cv2.resize(eight, (max(1, width // 2), max(1, height // 2)), interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".jpg", half, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return data.tobytes() if done else b""


def measure_setup(grey: Image, found: Detection | None, target: Target) -> Setup:
    """Return what helps to set a camera up."""
    top = int(np.iinfo(grey.dtype).max)
    counts = np.bincount(grey.ravel() >> (2 if top == 255 else 10), minlength=_BINS)
    shares = tuple(round(float(count) / grey.size, 6) for count in counts)
    saturated, dark = (float(np.count_nonzero(grey == end) / grey.size) for end in (top, 0))
    if found is None:
        return Setup(shares, saturated, dark)
    seen = np.isfinite(found.centres_px[:, 0])
    across, down = compute_keystone_percent(found.homography, target)
    return Setup(
        shares,
        saturated,
        dark,
        float(_EDGE_10_90 * np.median(found.state.parameters[seen, SIGMA])),
        float(np.median(found.state.contrast_DN()[seen])),
        compute_tilt_deg(found.homography, target),
        across,
        down,
        compute_roll_deg(found.homography, target),
    )


def compute_tilt_deg(homography: Float, target: Target) -> float | None:
    """The angle between target and image plane, from how much shorter it appears across the tilt: arccos of the ratio
    of the homography's two scales at the target's middle. Right near the optical axis, and blind below some degrees;
    None there."""
    middle = target.coordinates_mm().mean(axis=0)
    ends = project(homography, middle + _CORNER)
    small, large = sorted(np.linalg.svd((ends[1:] - ends[0]).T, compute_uv=False).tolist())
    ratio = small / large
    return float(np.degrees(np.arccos(ratio))) if ratio < _NEARLY_SQUARE else None


def compute_keystone_percent(homography: Float, target: Target) -> tuple[float, float]:
    """Return how much larger the end of the target that is right in the image appears than the left one, and the lower
    one than the upper one, %."""
    nominal = target.coordinates_mm()
    low, high = nominal.min(axis=0), nominal.max(axis=0)
    middle = (low + high) / 2
    places = np.array([(low[0], middle[1]), (high[0], middle[1]), (middle[0], low[1]), (middle[0], high[1])])
    at = project(homography, places)
    scales = np.array([_compute_scale(homography, place) for place in places])
    gradient, *_ = np.linalg.lstsq(at - at.mean(axis=0), np.log(scales), rcond=None)
    across, down = gradient * (at.max(axis=0) - at.min(axis=0)) * 100
    return float(across), float(down)


def _compute_scale(homography: Float, place: Float) -> float:
    """px per mm at a place: the square root of the area of a square millimetre."""
    corner, right, up = project(homography, place + _CORNER)
    (ax, ay), (bx, by) = right - corner, up - corner
    return float(np.sqrt(abs(ax * by - ay * bx)))
