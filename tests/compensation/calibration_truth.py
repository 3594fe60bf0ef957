"""The truth of a calibration, made without the program: camera, board with printing error, table with errors, noise.

Formulas are typed from OpenCV's documentation and elementary geometry; nothing here imports the calibration.
Camera frame: x right, y down, z forward, mm. Target: X right, Y up, marker 1 at the origin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.calibration.board import Board, make_board
from thermostand.compensation.calibration.pose import Lens, find_pose
from thermostand.compensation.calibration.session_centres import Positions
from thermostand.compensation.calibration.stage_geometry import TableGeometry
from thermostand.markers.target import Target

Float = NDArray[np.float64]

SIZE = (2448, 2048)
LINEAR_mm = (-140.0, -93.0, -47.0, 0.0, 47.0, 93.0, 140.0)
ROTARY_deg = (-30.0, -15.0, 0.0, 15.0, 30.0)
VALIDATION = ((0.0, 0.0), (25.0, 8.0), (-60.0, -20.0), (70.0, 22.0))
"""V0..V3: (linear mm, rotary deg)."""


@dataclass(frozen=True)
class TrueCamera:
    """Brown's pinhole; ripple_px: amplitude of a radial sine of 700 px period, and half of it along y with 900 px, that
    Brown's model cannot follow."""

    f_px: float = 7246.0
    cx_px: float = 1231.8
    cy_px: float = 1015.4
    k1: float = -0.12
    k2: float = 0.35
    p1: float = 2.0e-4
    p2: float = -3.0e-4
    k3: float = 0.0
    ripple_px: float = 0.0

    def project(self, points_mm: Float) -> Float:
        """(..., 2) px of points (..., 3)."""
        x, y = points_mm[..., 0] / points_mm[..., 2], points_mm[..., 1] / points_mm[..., 2]
        r2 = x * x + y * y
        radial = 1 + self.k1 * r2 + self.k2 * r2**2 + self.k3 * r2**3
        u = self.f_px * (x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)) + self.cx_px
        v = self.f_px * (y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y) + self.cy_px
        du, dv = u - SIZE[0] / 2, v - SIZE[1] / 2
        radius = np.hypot(du, dv) + 1e-9
        wave = self.ripple_px * np.sin(2 * math.pi * radius / 700)
        along = 0.5 * self.ripple_px * np.sin(2 * math.pi * v / 900)
        return np.stack([u + wave * du / radius, v + wave * dv / radius + along], axis=-1)


@dataclass(frozen=True)
class Truth:
    """One laboratory. Standard deviations of what is drawn: print, CMM, flatness, table, detection."""

    camera: TrueCamera = field(default_factory=TrueCamera)
    distance_mm: float = 826.0
    printing_mm: float = 0.020
    cmm_mm: float = 0.001
    flatness_mm: float = 0.0
    linear_mm: float = 0.0005
    rotary_arcmin: float = 0.1
    straightness_mm: float = 0.0
    wobble_arcmin: float = 0.0
    noise_px: float = 0.003
    diameter_mm: float = 8.0
    seed: int = 0
    board_seed: int | None = None  # the same as seed


@dataclass(frozen=True)
class Laboratory:
    """What was drawn. recorded (P, 2): linear mm and rotary deg as the table reports them. cmm_mm (54, 2). board_mm
    (54, 3): true. rotations, translations_mm: true poses at the positions, then at `validation`. centres_px: measured
    ellipse centres at both, noise and eccentricity included; covariance_px2 (2, 2) of each."""

    recorded: Float
    cmm_mm: Float
    board_mm: Float
    rotations: Float
    translations_mm: Float
    centres_px: Float
    validation_rotations: Float
    validation_translations_mm: Float
    validation_px: Float
    covariance_px2: Float


def true_table_frame() -> Float:
    """(3, 3): camera to table frame; Z along the rail, X right and Y down in the plane of rail and axis."""
    axis, rail = _axes()
    down = axis - rail * (rail @ axis)
    down = down / np.linalg.norm(down)
    return np.stack([np.cross(down, rail), down, rail])


def nominal_mm() -> Float:
    """(54, 2): 9 x 6, pitch 30 mm."""
    return np.array([(30.0 * column, 30.0 * row) for row in range(6) for column in range(9)])


def table_positions() -> Float:
    """(34, 2): the grid without its furthest, most oblique corner."""
    grid = [(linear, rotary) for linear in LINEAR_mm for rotary in ROTARY_deg]
    return np.array(grid[:-1])


def draw(truth: Truth) -> Laboratory:
    """The laboratory of this seed."""
    random = np.random.default_rng(truth.seed if truth.board_seed is None else truth.board_seed)
    board = np.column_stack([nominal_mm() + truth.printing_mm * random.standard_normal((54, 2)), np.zeros(54)])
    board[:, 2] = truth.flatness_mm * random.standard_normal(54)
    cmm = board[:, :2] + truth.cmm_mm * random.standard_normal((54, 2))
    random = np.random.default_rng((truth.seed, 1))
    recorded = table_positions()
    rotations, translations = _poses(truth, recorded, random)
    exact = Truth(linear_mm=0.0, rotary_arcmin=0.0, distance_mm=truth.distance_mm)
    validation = _poses(exact, np.array(VALIDATION), random)
    return Laboratory(
        recorded=recorded,
        cmm_mm=cmm,
        board_mm=board,
        rotations=rotations,
        translations_mm=translations,
        centres_px=_measured(truth, board, rotations, translations, random),
        validation_rotations=validation[0],
        validation_translations_mm=validation[1],
        validation_px=_measured(truth, board, *validation, random),
        covariance_px2=truth.noise_px**2 * np.eye(2),
    )


def ellipse_centres(
    camera: TrueCamera, board_mm: Float, rotation: Float, translation_mm: Float, diameter_mm: float
) -> Float:
    """(54, 2): area centroids of the projected discs, by summing the triangles of their outlines."""
    angle = np.linspace(0, 2 * math.pi, 181)[:-1]
    circle = diameter_mm / 2 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    outline = camera.project((board_mm[:, None] + circle) @ rotation.T + translation_mm)
    middle = camera.project(board_mm @ rotation.T + translation_mm)
    one, other = outline - middle[:, None], np.roll(outline, -1, axis=1) - middle[:, None]
    twice_area = one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]
    centroid = np.sum((one + other) / 3 * twice_area[..., None], axis=1) / np.sum(twice_area, axis=1)[:, None]
    return middle + centroid


def _measured(truth: Truth, board: Float, rotations: Float, translations: Float, random: np.random.Generator) -> Float:
    clean = np.array(
        [
            ellipse_centres(truth.camera, board, rotation, translation, truth.diameter_mm)
            for rotation, translation in zip(rotations, translations, strict=True)
        ]
    )
    return clean + truth.noise_px * random.standard_normal(clean.shape)


def _poses(truth: Truth, recorded: Float, random: np.random.Generator) -> tuple[Float, Float]:
    """True poses of the target when the table reports `recorded`; the table's errors are drawn."""
    count = len(recorded)
    axis, rail = _axes()
    sideways, upward = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    flip = np.diag([1.0, -1.0, -1.0])
    mount = _turn("z", 0.0075) @ _turn("x", 0.013) @ _turn("y", -0.004) @ flip
    centre_in_target = np.array([120.0, 75.0, 0.0])
    arm = mount @ -centre_in_target + np.array([1.4, 0.0, -6.0])
    linear = recorded[:, 0] + truth.linear_mm * random.standard_normal(count)
    rotary = np.radians(recorded[:, 1] + truth.rotary_arcmin / 60 * random.standard_normal(count))
    straight = truth.straightness_mm * random.standard_normal((count, 2))
    wobble = np.radians(truth.wobble_arcmin / 60 * random.standard_normal((count, 2)))
    rotations, translations = np.empty((count, 3, 3)), np.empty((count, 3))
    for index in range(count):
        turn = _turn("x", wobble[index, 0]) @ _turn("z", wobble[index, 1]) @ _about(axis, rotary[index])
        rotations[index] = turn @ mount
        moved = linear[index] * rail + straight[index, 0] * sideways + straight[index, 1] * upward
        translations[index] = np.array([2.0, -1.0, truth.distance_mm]) + moved + turn @ arm
    return rotations, translations


def _axes() -> tuple[Float, Float]:
    """Unit vectors of the rotary and the linear axis."""
    axis = _turn("y", 0.004) @ _turn("z", 0.006) @ np.array([0.0, 1.0, 0.0])
    return axis, _turn("y", 0.011) @ _turn("x", -0.007) @ np.array([0.0, 0.0, 1.0])


def _turn(axis: str, angle_rad: float) -> Float:
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    return {
        "x": np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]]),
        "y": np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]]),
        "z": np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]]),
    }[axis]


def _about(axis: Float, angle_rad: float) -> Float:
    """Rotation about a unit vector: first to it from z, then turned, then back."""
    helper = np.array([1.0, 0.0, 0.0])
    first = np.cross(axis, helper)
    first = first / np.linalg.norm(first)
    basis = np.column_stack([first, np.cross(axis, first), axis])
    return basis @ _turn("z", angle_rad) @ basis.T


# The drawn laboratory as the program gets it, and how far its poses are from the true ones.


CENTRE_mm = np.array([120.0, 75.0, 0.0])


def target_of(laboratory: Laboratory, *, measured: bool = True) -> Target:
    """The paper's target, with the drawn CMM coordinates or with nominal ones."""
    cmm = tuple((float(x), float(y)) for x, y in laboratory.cmm_mm) if measured else None
    return Target(name="drawn", columns=9, rows=6, pitch_mm=30, diameter_mm=8, cmm_mm=cmm)


def board(laboratory: Laboratory, *, measured: bool = True) -> Board:
    return make_board(target_of(laboratory, measured=measured))


def positions(laboratory: Laboratory) -> Positions:
    centres = laboratory.centres_px.copy()
    return Positions(
        linear_mm=laboratory.recorded[:, 0],
        rotary_deg=laboratory.recorded[:, 1],
        centres_px=centres,
        covariance_px2=np.tile(laboratory.covariance_px2, (*centres.shape[:2], 1, 1)),
        frames=np.ones(len(centres), np.int64),
        flags=np.zeros(centres.shape[:2], np.uint8),
        chi=float("nan"),
        image_size=SIZE,
    )


def covariances(laboratory: Laboratory) -> Float:
    return np.tile(laboratory.covariance_px2, (54, 1, 1))


def translation_errors_um(laboratory: Laboratory, lens: Lens, known: Board, table: TableGeometry) -> Float:
    """(3, 3): V0 -> V1, V2, V3 of the target's centre in the table's frame, found minus true, X Y Z in um."""
    poses = [find_pose(lens, known, centres, covariances(laboratory)) for centres in laboratory.validation_px]
    found = np.array([pose.locate_point_mm(CENTRE_mm) for pose in poses]) @ table.frame.T
    true = laboratory.validation_rotations @ CENTRE_mm + laboratory.validation_translations_mm
    true = true @ true_table_frame().T
    return 1e3 * ((found[1:] - found[0]) - (true[1:] - true[0]))
