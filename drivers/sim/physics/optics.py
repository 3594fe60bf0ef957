"""The true camera: where node temperatures put lens, sensor and target, and how target points then reach the sensor.

Frames. Laboratory frame: origin at the lens's perspective centre at 24 degC, x right, y down, z along the optical axis
to the target. Camera frame: the same, moved and turned with the camera. Pixels: x = column, y = row, integers are
pixel centres. The target lies in its own plane, X right, Y up, mm, marker 1 at the bottom left.

Every effect is a piece of hardware that expands with the temperature of the node it sits on; nothing here knows a
drift in px. The paper's section 8 names the motions left to the modified camera: sensor along its vertical axis and
about its horizontal one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

CameraKind = Literal["modified", "unmodified"]

WIDTH_px, HEIGHT_px = 2448, 2048
PITCH_mm = 3.45e-3  # of the sensor's pixels
FOCAL_px = 7246.0  # 25 mm: 114 um of the target per pixel at 826 mm
MARKER_COLUMNS, MARKER_ROWS = 9, 6
MARKER_STEP_mm, MARKER_DIAMETER_mm = 30.0, 8.0
REFERENCE_degC = 24.0
KELVIN = 273.15
OUTLINE_POINTS = 256

GRANITE_per_K = 5.0e-6
ALUMINIUM_per_K = 23.0e-6
GLASS_per_K = 9.0e-6


@dataclass(frozen=True)
class Nodes:
    """Temperatures that move the optics, degC, and the tensions of the joints, K (empty for the modified camera)."""

    sensor_degC: float
    body_degC: float
    lens_degC: float
    granite_inside_degC: float
    granite_outside_degC: float
    artifact_degC: float
    tensions_K: tuple[float, ...] = ()


@dataclass(frozen=True)
class StandPlacement:
    """Where the stand puts camera and target.

    linear_mm moves the target away from the camera. rotary_deg turns it about the vertical through its centre, the
    right edge away from the camera. camera_roll_deg turns the camera clockwise seen from behind, so the picture turns
    anticlockwise. target_roll_deg and target_offset_mm (right, down) keep the grid off the pixel raster.
    """

    linear_mm: float = 0.0
    rotary_deg: float = 0.0
    camera_roll_deg: float = 0.0
    distance_mm: float = 826.0
    target_offset_mm: tuple[float, float] = (1.37, -0.83)
    target_roll_deg: float = 0.43


@dataclass(frozen=True)
class Optics:
    """The camera and the target's pose at one instant; hashable, plain numbers.

    sensor_tilt_rad turns the sensor about its x and y axis; camera_turn_rad turns the camera about x, y, z (in that
    order), camera_shift_mm moves it, both in the laboratory frame. k1 is Brown's radial term on normalised coordinates.
    """

    f_px: float
    cx_px: float
    cy_px: float
    k1: float
    sensor_tilt_rad: tuple[float, float]
    camera_turn_rad: tuple[float, float, float]
    camera_shift_mm: tuple[float, float, float]
    target_centre_mm: tuple[float, float, float]
    target_turn_rad: float
    target_roll_rad: float
    target_scale: float


@dataclass(frozen=True)
class CameraDeformation:
    """What heat does to one camera: pixel-free displacements of its parts.

    sensor_mm: sensor against the lens axis (x, y); stretch: relative change of the image distance; tilt and turn as in
    Optics.
    """

    sensor_mm: tuple[float, float]
    stretch: float
    k1: float
    sensor_tilt_rad: tuple[float, float]
    turn_rad: tuple[float, float, float]


def compute_strain(temperature_degC: float, expansion_per_K: float, einstein_K: float) -> float:
    """Relative length change of a solid since 24 degC, `expansion_per_K` being its coefficient there.

    Expansion follows the energy of the lattice (Grueneisen), taken as an Einstein oscillator
    E = theta/(exp(theta/T) - 1): nearly linear for metals (theta 300 K), rising with T for stiff light solids.
    """
    reference_K = REFERENCE_degC + KELVIN
    ratio = einstein_K / reference_K
    heat_capacity = ratio**2 * math.exp(ratio) / (math.exp(ratio) - 1.0) ** 2
    energy_K = einstein_K / (math.exp(einstein_K / (temperature_degC + KELVIN)) - 1.0)
    reference_energy_K = einstein_K / (math.exp(ratio) - 1.0)
    return expansion_per_K * (energy_K - reference_energy_K) / heat_capacity


def compute_pad_sag_mm(temperature_degC: float) -> float:
    """Return how far the elastic lens mounting gives under its load: it softens by a third around 45 degC."""
    softening = 0.33 / (1.0 + math.exp((45.0 - temperature_degC) / 12.0))
    return 1.2e-3 / (1.0 - softening)


def deform_modified_camera(nodes: Nodes) -> CameraDeformation:
    """Sensor between granite columns, lens on granite prisms, no link between them (paper, section 4)."""
    carrier_mm = 11.2 * compute_strain(
        nodes.sensor_degC, ALUMINIUM_per_K, 1000.0
    )  # the sensor slides up between its columns
    barrel_mm = 4.6 * compute_strain(
        nodes.lens_degC, ALUMINIUM_per_K, 320.0
    )  # the barrel lifts the axis off the prisms
    sag_mm = compute_pad_sag_mm(nodes.lens_degC) - compute_pad_sag_mm(REFERENCE_degC)
    column_mm = 2.6 * compute_strain(nodes.body_degC, ALUMINIUM_per_K, 700.0)  # the columns are not quite alike
    prism_mm = 0.5 * compute_strain(nodes.lens_degC, ALUMINIUM_per_K, 320.0)  # nor are the prisms
    spacing = 0.8 * compute_strain(nodes.granite_inside_degC, GRANITE_per_K, 900.0)  # columns and prisms share the base
    lens = compute_strain(nodes.lens_degC, 4.5e-6, 800.0)
    sensor_warming_K = nodes.sensor_degC - REFERENCE_degC
    bow_rad = -1.8e-6 * (nodes.granite_inside_degC - nodes.granite_outside_degC)
    return CameraDeformation(
        sensor_mm=(column_mm - prism_mm, carrier_mm - barrel_mm - sag_mm),
        stretch=spacing + lens,
        k1=-0.12 + 1.0e-5 * (nodes.lens_degC - REFERENCE_degC),
        sensor_tilt_rad=(6.0e-6 * sensor_warming_K, 1.5e-6 * sensor_warming_K),
        turn_rad=(bow_rad, 0.0, 0.4e-6 * (nodes.granite_inside_degC - REFERENCE_degC)),
    )


def deform_unmodified_camera(nodes: Nodes, camera_roll_rad: float) -> CameraDeformation:
    """Sensor screwed to the housing, lens in a C-mount: larger, dependent on orientation, and it does not come back."""
    housing_mm = 14.0 * compute_strain(nodes.body_degC, ALUMINIUM_per_K, 320.0)
    board_mm = 4.0 * compute_strain(nodes.sensor_degC, 16.0e-6, 1100.0)
    mount_K = nodes.body_degC - nodes.lens_degC  # a gradient across the mount bends it
    droop_mm = 0.9e-4 * (nodes.body_degC - REFERENCE_degC)  # the mount yields to the lens's weight as it warms
    slack_K, grip_K = nodes.tensions_K if nodes.tensions_K else (0.0, 0.0)
    return CameraDeformation(
        sensor_mm=(
            0.28 * housing_mm + 5.0e-5 * slack_K + 4.0e-5 * grip_K + droop_mm * math.sin(camera_roll_rad),
            0.30 * housing_mm + board_mm + 11.0e-5 * slack_K + 8.0e-5 * grip_K + droop_mm * math.cos(camera_roll_rad),
        ),
        stretch=compute_strain(nodes.lens_degC, 4.5e-6, 800.0) + compute_strain(nodes.body_degC, 7.0e-6, 320.0),
        k1=-0.12 + 1.0e-5 * (nodes.lens_degC - REFERENCE_degC),
        sensor_tilt_rad=(9.0e-6 * mount_K, 4.0e-6 * mount_K),
        turn_rad=(3.0e-6 * mount_K, 1.0e-6 * mount_K, 2.0e-6 * grip_K),
    )


def compute_optics_at(kind: CameraKind, nodes: Nodes, placement: StandPlacement) -> Optics:
    """The camera and the target's pose for these temperatures and this placement."""
    roll_rad = math.radians(placement.camera_roll_deg)
    camera = deform_modified_camera(nodes) if kind == "modified" else deform_unmodified_camera(nodes, roll_rad)
    return compute_optics(camera, nodes, placement)


def compute_optics(camera: CameraDeformation, nodes: Nodes, placement: StandPlacement) -> Optics:
    """This camera before the target, with the stand's temperatures (those of `nodes` that are not the camera's)."""
    roll_rad = math.radians(placement.camera_roll_deg)
    inside = compute_strain(nodes.granite_inside_degC, GRANITE_per_K, 900.0)
    outside = compute_strain(nodes.granite_outside_degC, GRANITE_per_K, 900.0)
    half_mm = placement.distance_mm / 2.0  # the chamber's wall crosses the granite half way
    return Optics(
        f_px=FOCAL_px * (1.0 + camera.stretch),
        cx_px=(WIDTH_px - 1) / 2 + 6.3 + camera.sensor_mm[0] / PITCH_mm,
        cy_px=(HEIGHT_px - 1) / 2 - 4.1 + camera.sensor_mm[1] / PITCH_mm,
        k1=camera.k1,
        sensor_tilt_rad=camera.sensor_tilt_rad,
        camera_turn_rad=(camera.turn_rad[0], camera.turn_rad[1], camera.turn_rad[2] + roll_rad),
        camera_shift_mm=(0.0, -100.0 * inside, 0.0),  # the camera's granite post is 100 mm high
        target_centre_mm=(
            *placement.target_offset_mm,
            placement.distance_mm + placement.linear_mm + half_mm * (inside + outside),
        ),
        target_turn_rad=math.radians(placement.rotary_deg),
        target_roll_rad=math.radians(placement.target_roll_deg),
        target_scale=1.0 + compute_strain(nodes.artifact_degC, GLASS_per_K, 500.0),
    )


def make_marker_centres_mm() -> NDArray[np.float64]:
    """(54, 2) nominal centres (X right, Y up) about the target's centre; marker 1 bottom left, along the long side."""
    row, column = np.divmod(np.arange(MARKER_COLUMNS * MARKER_ROWS), MARKER_COLUMNS)
    centred = np.stack((column - (MARKER_COLUMNS - 1) / 2, row - (MARKER_ROWS - 1) / 2), axis=-1)
    return MARKER_STEP_mm * centred


def project(optics: Optics, target_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Image (..., 2) in px (x, y) of points (..., 2) of the target plane in mm, distortion and sensor tilt included."""
    plane = np.concatenate((target_mm * (1.0, -1.0), np.ones((*target_mm.shape[:-1], 1))), axis=-1)
    ray = plane @ _target_to_camera(optics).T
    normal = ray[..., :2] / ray[..., 2:]
    radius_squared = normal[..., :1] ** 2 + normal[..., 1:] ** 2
    distorted = normal * (1.0 + optics.k1 * radius_squared)
    on_sensor = np.concatenate((distorted, np.ones_like(ray[..., 2:])), axis=-1) @ _ray_to_sensor(optics).T
    return on_sensor[..., :2] / on_sensor[..., 2:] + (optics.cx_px, optics.cy_px)


def compute_outlines_px(optics: Optics, points: int = OUTLINE_POINTS) -> NDArray[np.float64]:
    """(54, points, 2) vertices of the projected disc outlines, px."""
    angle = 2.0 * math.pi * np.arange(points) / points
    circle_mm = MARKER_DIAMETER_mm / 2 * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    return project(optics, make_marker_centres_mm()[:, None, :] + circle_mm)


def compute_true_centres_px(optics: Optics) -> NDArray[np.float64]:
    """(54, 2) centroids (x, y) of the projected discs, px, by Green's theorem on the outline; marker 1 first."""
    outline = compute_outlines_px(optics)
    origin = outline.mean(axis=1, keepdims=True)  # keeps the products small
    here = outline - origin
    after = np.roll(here, -1, axis=1)
    cross = here[..., 0] * after[..., 1] - after[..., 0] * here[..., 1]
    moment = np.sum((here + after) * cross[..., None], axis=1)
    return origin[:, 0] + moment / (3.0 * np.sum(cross, axis=1)[:, None])


def _target_to_camera(optics: Optics) -> NDArray[np.float64]:
    """3 x 3 homography: (x right, y down, 1) of the target plane in mm to the camera frame in mm."""
    target = _turn(1, -optics.target_turn_rad) @ _turn(2, optics.target_roll_rad)
    columns = np.column_stack((optics.target_scale * target[:, :2], optics.target_centre_mm))
    columns[:, 2] -= optics.camera_shift_mm
    turn_x, turn_y, turn_z = optics.camera_turn_rad
    return _turn(2, -turn_z) @ _turn(1, -turn_y) @ _turn(0, -turn_x) @ columns


def _ray_to_sensor(optics: Optics) -> NDArray[np.float64]:
    """3 x 3 homography: distorted ray (x, y, 1) to px about the principal point on the tilted sensor."""
    axes = _turn(0, optics.sensor_tilt_rad[0]) @ _turn(1, optics.sensor_tilt_rad[1])
    sensor_to_ray = np.column_stack((axes[:, 0], axes[:, 1], (0.0, 0.0, optics.f_px)))
    return np.linalg.inv(sensor_to_ray)


def _turn(axis: int, angle_rad: float) -> NDArray[np.float64]:
    """Rotation matrix about axis 0, 1 or 2 by the right-hand rule."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[first, first] = matrix[second, second] = math.cos(angle_rad)
    matrix[second, first] = math.sin(angle_rad)
    matrix[first, second] = -matrix[second, first]
    return matrix
