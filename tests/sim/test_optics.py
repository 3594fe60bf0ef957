"""Projection against hand-made geometry, and the drift against the paper's amplitudes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from thermostand.drivers.sim.physics.optics import (
    CameraKind,
    FOCAL_px,
    Nodes,
    Optics,
    StandPlacement,
    compute_optics_at,
    compute_strain,
    compute_true_centres_px,
    make_marker_centres_mm,
    project,
)
from thermostand.drivers.sim.physics.plant import NS_PER_S, Plant, PlantSpec

START_ns = 1_700_000_000 * NS_PER_S
MINUTE_ns = 60 * NS_PER_S
COLD = Nodes(24.0, 24.0, 24.0, 24.0, 24.0, 24.0)
PLAIN = Optics(
    f_px=FOCAL_px,
    cx_px=1223.5,
    cy_px=1023.5,
    k1=0.0,
    sensor_tilt_rad=(0.0, 0.0),
    camera_turn_rad=(0.0, 0.0, 0.0),
    camera_shift_mm=(0.0, 0.0, 0.0),
    target_centre_mm=(0.0, 0.0, 826.0),
    target_turn_rad=0.0,
    target_roll_rad=0.0,
    target_scale=1.0,
)


def test_a_pixel_is_114_micrometres_of_the_target():
    centre, right, up = project(PLAIN, np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    assert centre == pytest.approx([1223.5, 1023.5])
    assert right - centre == pytest.approx([1 / 0.114, 0.0], abs=1e-3)
    assert up - centre == pytest.approx([0.0, -1 / 0.114], abs=1e-3)


def test_marker_1_is_bottom_left_and_numbers_run_along_the_long_side():
    centres = compute_true_centres_px(compute_optics_at("modified", COLD, StandPlacement()))
    assert centres.shape == (54, 2)
    assert centres[0, 0] < centres[8, 0]
    assert centres[0, 1] > centres[45, 1]
    assert make_marker_centres_mm()[[0, 1, 9]].tolist() == [[-120.0, -75.0], [-90.0, -75.0], [-120.0, -45.0]]
    assert (centres > 40.0).all()
    assert (centres < (2448 - 40, 2048 - 40)).all()


def test_moving_the_target_away_shrinks_it_about_the_principal_point():
    far = replace(PLAIN, target_centre_mm=(0.0, 0.0, 1652.0))
    points = make_marker_centres_mm()
    assert project(far, points) - (1223.5, 1023.5) == pytest.approx((project(PLAIN, points) - (1223.5, 1023.5)) / 2)


def test_a_positive_rotary_angle_turns_the_right_edge_away():
    turned = compute_optics_at(
        "modified", COLD, StandPlacement(rotary_deg=20.0, target_offset_mm=(0.0, 0.0), target_roll_deg=0.0)
    )
    point = project(replace(turned, k1=0.0), np.array([[100.0, 0.0]]))[0]
    depth_mm = 826.0 + 100.0 * math.sin(math.radians(20.0))
    assert point[0] - turned.cx_px == pytest.approx(FOCAL_px * 100.0 * math.cos(math.radians(20.0)) / depth_mm)
    assert point[1] == pytest.approx(turned.cy_px)


def test_rolling_the_camera_clockwise_turns_the_picture_anticlockwise():
    rolled = replace(PLAIN, camera_turn_rad=(0.0, 0.0, math.radians(20.0)))
    right = project(rolled, np.array([[1.0, 0.0]]))[0] - (1223.5, 1023.5)
    assert math.degrees(math.atan2(-right[1], right[0])) == pytest.approx(20.0)


def test_distortion_and_sensor_tilt_follow_their_definitions():
    point = np.array([[100.0, 0.0]])
    normal = 100.0 / 826.0
    bent = project(replace(PLAIN, k1=-0.12), point)[0]
    assert bent[0] - 1223.5 == pytest.approx(FOCAL_px * normal * (1.0 - 0.12 * normal**2))
    tilted = project(replace(PLAIN, sensor_tilt_rad=(0.0, 0.01)), point)[0]
    # a ray f (normal, 1) meets the plane turned by t about y where u cos t = normal (f - u sin t)
    expected = normal * FOCAL_px / (math.cos(0.01) + normal * math.sin(0.01))
    assert tilted[0] - 1223.5 == pytest.approx(expected)


def test_the_centroid_of_a_tilted_disc_is_the_centre_of_its_image_ellipse():
    turned = replace(PLAIN, target_turn_rad=math.radians(30.0))
    centres = compute_true_centres_px(turned)
    for marker in (0, 26, 53):
        x, y = make_marker_centres_mm()[marker]
        assert centres[marker] == pytest.approx(_ellipse_centre(turned, x, y), abs=2e-5)
    eccentricity_px = np.abs(centres - project(turned, make_marker_centres_mm())).max()
    assert 0.005 < eccentricity_px < 0.1


def _ellipse_centre(optics: Optics, x_mm: float, y_mm: float, radius_mm: float = 4.0) -> NDArray[np.float64]:
    """Centre of the image of a circle from its dual conic under the plane's homography, estimated from four points."""
    corners = np.array([[-50.0, -50.0], [50.0, -50.0], [50.0, 50.0], [-50.0, 50.0]])
    rows: list[tuple[float, ...]] = []
    for (a, b), (u, v) in zip(corners.tolist(), project(optics, corners).tolist(), strict=True):
        rows += [(a, b, 1, 0, 0, 0, -u * a, -u * b, -u), (0, 0, 0, a, b, 1, -v * a, -v * b, -v)]
    homography = np.linalg.svd(np.array(rows))[2][-1].reshape(3, 3)
    move = np.array([[1.0, 0.0, x_mm], [0.0, 1.0, y_mm], [0.0, 0.0, 1.0]])
    dual = homography @ move @ np.diag([radius_mm**2, radius_mm**2, -1.0]) @ move.T @ homography.T
    return dual[:2, 2] / dual[2, 2]


def test_solids_expand_by_their_coefficient_and_a_little_faster_when_warm():
    assert compute_strain(24.0, 23e-6, 320.0) == 0.0
    assert compute_strain(25.0, 23e-6, 320.0) - compute_strain(23.0, 23e-6, 320.0) == pytest.approx(46e-6, rel=1e-4)
    assert compute_strain(54.0, 23e-6, 1000.0) > -compute_strain(-6.0, 23e-6, 1000.0)


def test_the_glass_target_grows_with_its_own_temperature():
    warm = compute_true_centres_px(compute_optics_at("modified", replace(COLD, artifact_degC=34.0), StandPlacement()))
    cold = compute_true_centres_px(compute_optics_at("modified", COLD, StandPlacement()))
    width_change = np.ptp(warm[:9, 0]) / np.ptp(cold[:9, 0]) - 1.0
    assert width_change == pytest.approx(9.0e-5, rel=0.03)


@dataclass(frozen=True)
class Trajectory:
    """Marker centres of a warm-up at 24 degC and of a cycle of 45-minute set-points in an ideal chamber."""

    warm_up: NDArray[np.float64]
    set_points_degC: NDArray[np.float64]
    drift: NDArray[np.float64]


CYCLE_degC = (*range(24, 53, 4), *range(48, 11, -4), 10, *range(12, 25, 4))


def live_through(kind: CameraKind, roll_deg: float = 0.0, cycle_degC: tuple[int, ...] = CYCLE_degC) -> Trajectory:
    spec = PlantSpec(kind, laboratory_swing_K=0.0, camera_powered=True, camera_roll_deg=roll_deg)
    plant = Plant(spec, START_ns)
    air_degC = 24.0

    def pin(time_ns: int, dt_s: float) -> None:
        plant.bulk_air_degC = plant.wall_degC = air_degC

    def seen(minutes: int) -> NDArray[np.float64]:
        plant.advance(plant.now_ns + minutes * MINUTE_ns)
        return compute_true_centres_px(plant.optics(plant.now_ns))

    plant.on_step.append(pin)
    cold = seen(0)
    warm_up = np.array([seen(5) - cold for _ in range(9)])
    drift: list[NDArray[np.float64]] = []
    reference = seen(120) if cycle_degC else cold
    for set_point_degC in cycle_degC:
        air_degC = float(set_point_degC)
        drift.append(seen(45) - reference)
    return Trajectory(warm_up, np.array(cycle_degC, dtype=float), np.array(drift))


@pytest.fixture(scope="module")
def modified() -> Trajectory:
    return live_through("modified")


@pytest.fixture(scope="module")
def unmodified() -> Trajectory:
    return live_through("unmodified")


def rms(drift: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sqrt(np.mean(drift**2, axis=(0, 1)))


def test_the_warm_up_drifts_by_the_papers_0_3_and_1_1_px(modified: Trajectory):
    mean = np.abs(modified.warm_up[-1].mean(axis=0))
    assert mean == pytest.approx([0.3, 1.1], abs=0.08)


def test_the_modified_camera_drifts_by_the_papers_0_2_and_0_6_px_rms(modified: Trajectory):
    assert rms(modified.drift) == pytest.approx([0.2, 0.6], abs=0.05)


def test_markers_drift_differently(modified: Trajectory):
    hottest = modified.drift[CYCLE_degC.index(52)]
    assert 0.05 < np.std(hottest[:, 0]) < 0.3
    assert 0.03 < np.std(hottest[:, 1]) < 0.3


def test_the_modified_camera_comes_back_but_remembers_its_granite(modified: Trajectory):
    ends = modified.drift[modified.set_points_degC == 24.0].mean(axis=1)
    assert np.abs(ends).max() < 0.05
    gap = np.ptp(modified.drift[modified.set_points_degC == 40.0].mean(axis=1), axis=0)
    assert 0.01 < gap[1] < 0.06  # lags of lens and base, not hysteresis


def test_a_longer_soak_closes_the_modified_cameras_loop():
    plant = Plant(PlantSpec(laboratory_swing_K=0.0, camera_powered=True), START_ns)
    centres: list[NDArray[np.float64]] = []
    for hot_degC in (24.0, 44.0, 24.0):
        plant.on_step[:] = [lambda time_ns, dt_s, degC=hot_degC: _pin(plant, degC)]
        plant.advance(plant.now_ns + 12 * 60 * MINUTE_ns)
        centres.append(compute_true_centres_px(plant.optics(plant.now_ns)))
    assert np.abs(centres[1] - centres[0]).max() > 0.4
    assert np.abs(centres[2] - centres[0]).max() < 0.002


def _pin(plant: Plant, air_degC: float) -> None:
    plant.bulk_air_degC = plant.wall_degC = air_degC


def test_the_unmodified_camera_drifts_more_and_does_not_come_back(modified: Trajectory, unmodified: Trajectory):
    assert (rms(unmodified.drift) > 1.5 * rms(modified.drift)).all()
    ends = unmodified.drift[unmodified.set_points_degC == 24.0].mean(axis=1)
    assert (np.ptp(ends, axis=0) > (0.15, 0.3)).all()


def test_only_the_unmodified_cameras_path_depends_on_its_orientation(modified: Trajectory, unmodified: Trajectory):
    def change(kind: CameraKind, upright: Trajectory) -> NDArray[np.float64]:
        rolled = live_through(kind, roll_deg=20.0, cycle_degC=())
        return np.abs(rolled.warm_up.mean(axis=1) - upright.warm_up.mean(axis=1)).max(axis=0)

    assert (change("modified", modified) < 0.005).all()
    assert change("unmodified", unmodified)[0] > 0.1
