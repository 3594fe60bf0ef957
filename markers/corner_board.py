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
from thermostand.markers.april_grid import AprilGrid, find_tag_corners
from thermostand.markers.noise import Image, full_scale_DN

SIGMA_px = 0.03

Positive = Annotated[float, Field(gt=0)]
Float = NDArray[np.float64]


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
    def _consistent(self) -> CornerBoard:
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
    grey = image if image.dtype == np.uint8 else cv2.convertScaleAbs(image, alpha=255 / full_scale_DN(image))
    if isinstance(board, AprilGrid):
        found = find_tag_corners(grey, board)
    else:
        found = _checkerboard(grey, board) if board.kind == "checkerboard" else _charuco(grey, board)
    if found is None:
        raise DetectionError(f"the {board.columns} x {board.rows} {board.kind} {board.name} was not found")
    return found


def _checkerboard(grey: cv2.typing.MatLike, board: CornerBoard) -> Float | None:
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


def _charuco(grey: cv2.typing.MatLike, board: CornerBoard) -> Float | None:
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
