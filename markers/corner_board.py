"""Boards of corners (checkerboards, ChArUco boards, AprilGrids), found by OpenCV: for calibrations without dots.

Corners are points of the board's frame: X right along its columns, Y up, Z towards the camera, mm, origin at the top
left of the printed pattern. OpenCV says nothing of a corner's uncertainty: `SIGMA_px` is assumed, and a calibration
finds what is missing from its residuals.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from thermostand.foundation.documents import Document, load_document, read_document
from thermostand.foundation.errors import DetectionError
from thermostand.markers.noise import Image, find_full_scale_DN

# AprilGrids as Kalibr prints them: tags with a border of two bits, a black square at each of their corners.
#
# The numbers of the tags say where they are in the grid. Which corner of a tag is which follows from the places of the
# tags and not from its bits: OpenCV 4 and OpenCV 5 turn the bits of the same tag by 180 deg.

Positive = Annotated[float, Field(gt=0)]
Float = NDArray[np.float64]

_BORDER_BITS = 2  # of the AprilTags that are printed with such a board
_LEAST_TAGS = 4  # four fit a homography
_NEAR = 0.25
"""Of a tag's side: how far a corner may lie from where the places of the tags expect it."""


class AprilGrid(Document):
    """columns, rows: tags. tag_mm: their side, black border included. gap_mm: between two tags, which is the side of
    the black squares (Kalibr's tagSpacing is gap_mm / tag_mm). Numbers begin with first_id at the lower left and go
    along the rows, upwards. printing_error_mm, flatness_mm: standard uncertainties of a corner's place in the plane,
    and of its height above it.
    """

    name: str
    kind: Literal["aprilgrid"]
    columns: Annotated[int, Field(ge=2)]
    rows: Annotated[int, Field(ge=2)]
    tag_mm: Positive
    gap_mm: Positive
    dictionary: str = "DICT_APRILTAG_36h11"
    first_id: Annotated[int, Field(ge=0)] = 0
    printing_error_mm: Positive = 0.05
    flatness_mm: Positive = 0.05

    @model_validator(mode="after")
    def _check_consistent(self) -> AprilGrid:
        if not isinstance(getattr(cv2.aruco, self.dictionary, None), int):
            raise ValueError(f"OpenCV has no dictionary {self.dictionary}: it is one like DICT_APRILTAG_36h11")
        tags = len(_load_dictionary(self).bytesList)
        if self.first_id + self.columns * self.rows > tags:
            raise ValueError(
                f"{self.dictionary} has {tags} tags, the grid {self.columns * self.rows} from {self.first_id} on"
            )
        return self

    @property
    def count(self) -> int:
        """How many corners the grid has: four a tag."""
        return 4 * self.columns * self.rows

    @property
    def orientation(self) -> str:
        """How it is known which way up the grid is, in a sentence."""
        return "orientation: by the numbers of the tags"

    def tags_mm(self) -> Float:
        """The tags' lower left corners (N / 4, 2), in the order of their numbers."""
        row, column = np.divmod(np.arange(self.columns * self.rows), self.columns)
        return np.stack([column, row], axis=1) * (self.tag_mm + self.gap_mm) + self.gap_mm

    def coordinates_mm(self) -> Float:
        """Corners (N, 2), X right and Y up from the grid's lower left: tag by tag, each counter-clockwise from its
        lower left."""
        corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * self.tag_mm
        return (self.tags_mm()[:, None] + corners).reshape(-1, 2)


def find_tag_corners(grey: cv2.typing.MatLike, grid: AprilGrid) -> Float | None:
    """Corners (N, 2), px, in the order of `coordinates_mm`, NaN where not seen; None when fewer than four tags are."""
    settings = cv2.aruco.DetectorParameters()
    settings.markerBorderBits = _BORDER_BITS
    found, ids, _ = cv2.aruco.ArucoDetector(_load_dictionary(grid), settings).detectMarkers(grey)
    if np.ndim(ids) == 0 or not np.size(ids):
        return None
    number = np.asarray(ids, np.intp).ravel() - grid.first_id
    ours = (number >= 0) & (number < grid.columns * grid.rows)
    quads, number = np.asarray(found, np.float64).reshape(-1, 4, 2)[ours], number[ours]
    placed = _assign_corners(quads, number, grid)
    if placed is None:
        return None
    seen = np.isfinite(placed[:, 0])
    placed[seen] = _refine_corners(grey, placed[seen], grid)
    return placed


def _assign_corners(quads: Float, number: NDArray[np.intp], grid: AprilGrid) -> Float | None:
    """Each tag's corners (K, 4, 2), px, in their places among the grid's, by a plane through the tags' middles."""
    middles = grid.tags_mm()[number] + grid.tag_mm / 2
    if len(quads) < _LEAST_TAGS:
        return None
    plane, _ = cv2.findHomography(middles, quads.mean(axis=1), cv2.RANSAC, 0.1 * _find_shortest_side_px(quads))
    if np.shape(plane) != (3, 3) or not np.isfinite(plane).all():
        return None
    places = grid.coordinates_mm().reshape(-1, 4, 2)[number]
    expected = cv2.perspectiveTransform(places.reshape(-1, 1, 2), plane).reshape(-1, 4, 2)
    apart = np.linalg.norm(expected[:, :, None] - quads[:, None], axis=3)
    nearest = apart.argmin(axis=2)
    near = (apart.min(axis=2) < _NEAR * _find_shortest_side_px(quads)).all(axis=1)
    once = (np.sort(nearest, axis=1) == np.arange(4)).all(axis=1) & near
    if np.count_nonzero(once) < _LEAST_TAGS:
        return None
    corners = np.full((grid.columns * grid.rows, 4, 2), np.nan)
    corners[number[once]] = np.take_along_axis(quads, nearest[:, :, None], axis=1)[once]
    return corners.reshape(-1, 2)


def _refine_corners(grey: cv2.typing.MatLike, rough: Float, grid: AprilGrid) -> Float:
    """The corners to a part of a pixel: black touches black there, as in a checkerboard."""
    side = _find_shortest_side_px(rough.reshape(-1, 4, 2))
    half = int(np.clip(0.3 * side * min(grid.gap_mm / grid.tag_mm, 1), 2, 11))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
    fine = cv2.cornerSubPix(grey, rough.astype(np.float32).reshape(-1, 1, 2), (half, half), (-1, -1), criteria)
    return np.asarray(fine, np.float64).reshape(-1, 2)


def _find_shortest_side_px(quads: Float) -> float:
    """The shortest side of any tag."""
    return float(np.linalg.norm(quads - np.roll(quads, 1, axis=1), axis=2).min())


def _load_dictionary(grid: AprilGrid) -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, grid.dictionary))


SIGMA_px = 0.03


class CornerBoard(Document):
    """A board of squares. columns, rows: squares; square_mm: their side. marker_mm and dictionary (`DICT_4X4_50`):
    those of a ChArUco board; legacy_pattern: printed by OpenCV before 4.6. printing_error_mm, flatness_mm: standard
    uncertainties of a corner's place in the plane, and of its height above it.
    """

    name: str
    kind: Literal["checkerboard", "charuco"]
    columns: Annotated[int, Field(ge=4)]
    rows: Annotated[int, Field(ge=4)]
    square_mm: Positive
    marker_mm: Positive | None = None
    dictionary: str | None = None
    legacy_pattern: bool = False
    printing_error_mm: Positive = 0.05
    flatness_mm: Positive = 0.05

    @model_validator(mode="after")
    def _check_consistent(self) -> CornerBoard:
        is_charuco = self.kind == "charuco"
        if is_charuco != (self.marker_mm is not None) or is_charuco != (self.dictionary is not None):
            raise ValueError("a charuco board has marker_mm and dictionary, a checkerboard neither")
        if self.marker_mm is not None and self.marker_mm >= self.square_mm:
            raise ValueError(f"markers of {self.marker_mm} mm do not fit into squares of {self.square_mm} mm")
        if self.dictionary is not None and not isinstance(getattr(cv2.aruco, self.dictionary, None), int):
            raise ValueError(f"OpenCV has no dictionary {self.dictionary}: it is one like DICT_4X4_50")
        return self

    @property
    def count(self) -> int:
        """How many corners the board has: where four squares meet."""
        return (self.columns - 1) * (self.rows - 1)

    @property
    def orientation(self) -> str:
        """How it is known which way up the board is, in a sentence."""
        if self.kind == "charuco":
            return "orientation: by the markers in the squares"
        return (
            f"orientation: {self.name} may look the same after half a turn; that changes no camera, but in pictures of "
            "both ways up the places of its corners are mixed up"
        )

    def coordinates_mm(self) -> Float:
        """Corners (N, 2), row by row from the top left, X right and Y up."""
        row, column = np.divmod(np.arange(self.count), self.columns - 1)
        return np.stack([column + 1, -(row + 1)], axis=1) * self.square_mm


BoardOfCorners = CornerBoard | AprilGrid
"""A board whose points are corners."""


def load_corner_board(path: Path) -> BoardOfCorners | None:
    """The board of a file that says of which `kind` it is; None for others, which are of dots. ConfigError when it
    cannot be read."""
    kinds = [line.split(":", 1)[1] for line in read_document(path).splitlines() if line.startswith("kind:")]
    if not kinds:
        return None
    return load_document(path, AprilGrid if "aprilgrid" in kinds[0] else CornerBoard)


def find_corners(image: Image, board: BoardOfCorners) -> Float:
    """Corners (N, 2), px, in the order of `coordinates_mm`, NaN where not seen. Raises DetectionError when there are
    none."""
    grey = image if image.dtype == np.uint8 else cv2.convertScaleAbs(image, alpha=255 / find_full_scale_DN(image))
    if isinstance(board, AprilGrid):
        found = find_tag_corners(grey, board)
    else:
        found = _find_checkerboard(grey, board) if board.kind == "checkerboard" else _find_charuco(grey, board)
    if found is None:
        raise DetectionError(f"the {board.columns} x {board.rows} {board.kind} {board.name} was not found")
    return found


def _find_checkerboard(grey: cv2.typing.MatLike, board: CornerBoard) -> Float | None:
    size = (board.columns - 1, board.rows - 1)
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    success, corners = cv2.findChessboardCorners(grey, size, flags=flags)
    if not success:
        return None
    rough = np.asarray(corners, np.float64).reshape(-1, 2)
    # The window ends half way to the next corner, seen at a slant.
    half = int(np.clip(0.3 * np.linalg.norm(np.diff(rough[: size[0]], axis=0), axis=1).min(), 2, 11))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
    fine = cv2.cornerSubPix(grey, rough.astype(np.float32), (half, half), (-1, -1), criteria)
    return np.asarray(fine, np.float64).reshape(-1, 2)


def _find_charuco(grey: cv2.typing.MatLike, board: CornerBoard) -> Float | None:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, str(board.dictionary)))
    pattern = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.square_mm, float(board.marker_mm or 0), dictionary
    )
    pattern.setLegacyPattern(board.legacy_pattern)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(pattern).detectBoard(grey)
    if not np.size(ids) or np.ndim(ids) == 0:
        return None
    found = np.full((board.count, 2), np.nan)
    found[np.asarray(ids, np.intp).ravel()] = np.asarray(corners, np.float64).reshape(-1, 2)
    return found
