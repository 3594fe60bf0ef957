"""The simulated stand's own camera, found from its positions of the calibration recipe: no code is shared with it."""

from __future__ import annotations

import numpy as np
import yaml

from thermostand.compensation.calibration.adjustment import adjust
from thermostand.compensation.calibration.board import board_of
from thermostand.compensation.calibration.calibrate import rays_of
from thermostand.compensation.calibration.pose import find_pose
from thermostand.compensation.calibration.session_centres import Positions
from thermostand.compensation.calibration.stage_geometry import TableSigma
from thermostand.drivers.sim.physics.optics import Nodes, Optics, StandPlacement, optics_at, true_centres_px
from thermostand.markers.target import load_target
from thermostand.stand.config.stand_config import packaged

NOISE_px = 0.0012  # the mean of five frames
WARM = Nodes(43.0, 39.0, 38.0, 24.0, 24.25, 24.2)  # after hours in a chamber at 24 degC
MIDDLE_mm = np.array([120.0, 75.0, 0.0])
VALIDATION = ((70.0, 0.0), (95.0, 8.0), (10.0, -20.0), (140.0, 22.0))


def optics(linear_mm: float, rotary_deg: float) -> Optics:
    return optics_at("modified", WARM, StandPlacement(linear_mm=linear_mm, rotary_deg=rotary_deg))


def recipe_places() -> np.ndarray:
    recipe = yaml.safe_load(packaged("recipes", "calibration").read_text())["experiments"][0]["calibration"]
    left_out = [(entry["linear_mm"], entry["rotary_deg"]) for entry in recipe["left_out"]]
    grid = [(z, angle) for z in recipe["linear_mm"] for angle in recipe["rotary_deg"]]
    return np.array([place for place in grid if place not in left_out], float)


def test_the_recipes_positions_give_the_stands_camera_and_its_validation_positions():
    random = np.random.default_rng(4)
    places = recipe_places()
    assert len(places) == 34
    centres = np.array([true_centres_px(optics(*place)) for place in places])
    covariance = np.tile(NOISE_px**2 * np.eye(2), (34, 54, 1, 1))
    seen = Positions(
        places[:, 0],
        places[:, 1],
        centres + NOISE_px * random.standard_normal(centres.shape),
        covariance,
        np.full(34, 5),
        np.zeros((34, 54), np.uint8),
        1.0,
        (2448, 2048),
    )
    found = adjust(seen, board_of(load_target(packaged("targets", "paper-9x6"))), TableSigma())
    true = optics(0.0, 0.0)
    assert found.reprojection_ratio < 1.05
    assert abs(found.scene.lens.vector[0] - true.f_px) < 4 * found.camera_sigma[0] + 0.01
    # A tilted sensor is a turned camera whose principal point is elsewhere.
    principal = np.array([true.cx_px, true.cy_px]) + true.f_px * np.array(
        [true.sensor_tilt_rad[1], -true.sensor_tilt_rad[0]]
    )
    assert np.all(np.abs(found.scene.lens.vector[2:4] - principal) < 4 * found.camera_sigma[2:4])
    for lens in (found.scene.lens, rays_of(found, 5)):
        poses = [
            find_pose(lens, found.adjusted_board, true_centres_px(optics(*place)), covariance[0])
            for place in VALIDATION
        ]
        places_mm = np.array([pose.place_mm(MIDDLE_mm) for pose in poses]) @ found.scene.table.frame.T
        moved_um = 1e3 * (places_mm[1:] - places_mm[0])
        wanted_um = 1e3 * np.array([(0, 0, linear_mm - VALIDATION[0][0]) for linear_mm, _ in VALIDATION[1:]])
        assert np.all(np.abs(moved_um - wanted_um) < (1.0, 1.0, 2.0))
