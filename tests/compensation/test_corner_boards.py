"""Checkerboards, ChArUco boards, AprilGrids: corners where OpenCV drew them, and a camera from pictures of them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from tests.nightly import mark_nightly
from thermostand.compensation.cli import app
from thermostand.foundation.errors import ConfigError, DetectionError
from thermostand.markers.corner_board import AprilGrid, BoardOfCorners, CornerBoard, find_corners, load_corner_board

SIZE = (1224, 1024)
MATRIX = np.array([[2000.0, 0, 611.5], [0, 2000.0, 511.5], [0, 0, 1]])
SIDE_px = 100
POSES = [(0, 0, 0), (28, 4, 2), (-28, 0, 6), (5, 30, -5), (0, -30, 3), (22, 20, 8), (-20, 18, -6)]
"""Angles about x, y and z, deg."""

CHECKERBOARD = CornerBoard(name="c", kind="checkerboard", columns=10, rows=7, square_mm=25)
CHARUCO = CornerBoard(
    name="a", kind="charuco", columns=10, rows=7, square_mm=25, marker_mm=18, dictionary="DICT_5X5_100"
)
APRILGRID = AprilGrid(name="t", kind="aprilgrid", columns=6, rows=4, tag_mm=32, gap_mm=8, first_id=3)
BOARDS = {"checkerboard": CHECKERBOARD, "charuco": CHARUCO, "aprilgrid": APRILGRID}


def drawn(board: BoardOfCorners) -> NDArray[np.uint8]:
    if isinstance(board, AprilGrid):
        return drawn_tags(board)
    size = (board.columns * SIDE_px, board.rows * SIDE_px)
    if board.kind == "charuco":
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
        pattern = cv2.aruco.CharucoBoard((board.columns, board.rows), 25, 18, dictionary)
        return np.asarray(pattern.generateImage(size), np.uint8)
    row, column = np.indices(size[::-1]) // SIDE_px
    return (255 * ((row + column) % 2)).astype(np.uint8)


def drawn_tags(grid: AprilGrid) -> NDArray[np.uint8]:
    """As Kalibr prints it, with OpenCV's tags, at 4 px/mm."""
    tag, gap = int(4 * grid.tag_mm), int(4 * grid.gap_mm)
    pitch = tag + gap
    image = np.full((grid.rows * pitch + gap, grid.columns * pitch + gap), 255, np.uint8)
    for row in range(grid.rows + 1):
        for column in range(grid.columns + 1):
            image[row * pitch : row * pitch + gap, column * pitch : column * pitch + gap] = 0
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, grid.dictionary))
    for number in range(grid.columns * grid.rows):
        row, column = divmod(number, grid.columns)
        top, left = gap + (grid.rows - 1 - row) * pitch, gap + column * pitch
        tag_image = dictionary.generateImageMarker(grid.first_id + number, tag, borderBits=2)
        image[top : top + tag, left : left + tag] = tag_image
    return image


def pictured(
    board: BoardOfCorners, pose: tuple[int, int, int], seed: int
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """A picture of the drawn board in a pose 600 mm away, and where its corners are in it."""
    places = board.coordinates_mm()
    turn = np.diag([1.0, -1.0, -1.0]) @ Rotation.from_euler("xyz", pose, degrees=True).as_matrix()
    shift = np.array([0, 0, 600.0]) - turn @ np.array([*places.mean(axis=0), 0])
    plane = MATRIX @ np.column_stack([turn[:, :2], shift])
    per_px = 0.25
    top = drawn(board).shape[0] * per_px if isinstance(board, AprilGrid) else 0.0
    from_drawing = np.array([[per_px, 0, per_px / 2], [0, -per_px, top - per_px / 2], [0, 0, 1]])
    wide = cv2.copyMakeBorder(drawn(board), 100, 100, 100, 100, cv2.BORDER_CONSTANT, value=[255])
    moved = from_drawing @ np.array([[1.0, 0, -100], [0, 1, -100], [0, 0, 1]])
    image = cv2.warpPerspective(wide, plane @ moved, SIZE, borderMode=cv2.BORDER_CONSTANT, borderValue=[255])
    image = cv2.GaussianBlur(image, (0, 0), 0.8).astype(np.float64) * 0.7 + 20
    image += np.random.default_rng(seed).standard_normal(image.shape)
    mapped = np.column_stack([places, np.ones(len(places))]) @ plane.T
    return np.clip(np.round(image), 0, 255).astype(np.uint8), mapped[:, :2] / mapped[:, 2:]


@pytest.mark.parametrize("kind", BOARDS)
def test_corners_are_where_they_were_drawn(kind: str):
    image, truth = pictured(BOARDS[kind], (20, 10, 5), 1)
    found = find_corners(image, BOARDS[kind])
    off = np.linalg.norm(found - truth, axis=1)
    turned = np.linalg.norm(found - truth[::-1], axis=1)  # a checkerboard may begin at either end
    assert min(np.max(off), np.max(turned) if kind == "checkerboard" else np.inf) < 0.3
    if kind == "charuco":
        deep = find_corners(image.astype(np.uint16) * 16, BOARDS[kind])
        np.testing.assert_allclose(deep, found, atol=0.1)


def test_covered_corners_of_a_charuco_board_are_nan_and_the_others_keep_their_places():
    image, truth = pictured(CHARUCO, (0, 0, 0), 1)
    image[:, :400] = 128
    found = find_corners(image, CHARUCO)
    seen = np.isfinite(found[:, 0])
    assert 10 < seen.sum() < CHARUCO.count
    assert np.linalg.norm(found - truth, axis=1)[seen].max() < 0.3


def test_covered_tags_are_nan_upside_down_too_and_tags_of_other_grids_are_not_taken():
    image, truth = pictured(APRILGRID, (0, 0, 170), 1)
    image[:, :400] = 128
    found = find_corners(image, APRILGRID)
    seen = np.isfinite(found[:, 0])
    assert 16 < seen.sum() < APRILGRID.count
    assert np.linalg.norm(found - truth, axis=1)[seen].max() < 0.3
    shifted = APRILGRID.model_copy(update={"first_id": 8, "columns": 2, "rows": 1})
    with pytest.raises(DetectionError):
        find_corners(image, shifted)


def test_a_grid_of_more_tags_than_the_family_has_is_refused():
    with pytest.raises(ValueError, match="DICT_APRILTAG_16h5 has 30 tags, the grid 36 from 0 on"):
        AprilGrid(name="g", kind="aprilgrid", columns=6, rows=6, tag_mm=30, gap_mm=9, dictionary="DICT_APRILTAG_16h5")


@pytest.mark.parametrize("kind", BOARDS)
def test_a_wall_has_no_corners(kind: str):
    with pytest.raises(DetectionError, match=rf"the \d+ x \d {kind} . was not found"):
        find_corners(np.full((600, 800), 128, np.uint8), BOARDS[kind])


def test_files_that_say_their_kind_are_boards_of_squares_and_others_are_not(tmp_path: Path):
    path = tmp_path / "board.yaml"
    path.write_text("name: b\nkind: checkerboard\ncolumns: 9\nrows: 6\nsquare_mm: 20\n")
    board = load_corner_board(path)
    assert board is not None
    assert (board.count, board.coordinates_mm()[0].tolist()) == (40, [20, -20])
    path.write_text(path.read_text() + "marker_mm: 10\n")
    with pytest.raises(ConfigError, match="marker_mm and dictionary, a checkerboard"):
        load_corner_board(path)
    path.write_text("name: b\ncolumns: 9\n")
    assert load_corner_board(path) is None


@pytest.mark.parametrize("kind", ["aprilgrid", mark_nightly("charuco"), mark_nightly("checkerboard")])
def test_the_command_calibrates_from_corners(kind: str, tmp_path: Path):
    board = BOARDS[kind]
    described = tmp_path / "board.yaml"
    described.write_text("\n".join(f"{key}: {value}" for key, value in board.model_dump(exclude_none=True).items()))
    paths: list[str] = []
    for number, pose in enumerate(POSES):
        paths.append(str(tmp_path / f"{number}.png"))
        cv2.imwrite(paths[-1], pictured(board, pose, number)[0])
    arguments = ["calibrate-photographs", *paths, "--target", str(described), "--export", str(tmp_path / "out")]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    words = next(line for line in result.stdout.splitlines() if line.strip().startswith("fx")).split()
    assert abs(float(words[1]) - 2000) < 4 * float(words[3])
    assert float(words[3]) < 5
    assert board.orientation in result.stdout
