"""The judge of a soak against rates of known truth."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from thermostand.experiments.steps import SoakUntilSettled
from thermostand.markers.detection import Detection
from thermostand.markers.edge_model import EdgeState
from thermostand.stand.imaging.settling import (
    Rate,
    SettlingData,
    find_digit_K,
    fit_camera_rate,
    fit_drift_rate,
    judge_settling,
    measure_movement,
)

SOAK = SoakUntilSettled(
    max_s=2700.0,
    min_s=600.0,
    window_s=600.0,
    look_every_s=120.0,
    camera_K_per_min=0.1,
    drift_px_per_min=0.002,
    exposure_s=0.1,
    chamber_degC=30.0,
)
NOW_S = 1.8e9
LOOK_PX = 0.0003  # of the mean of 54 markers


def polls(value: float | NDArray[Any], length_s: float = 900.0) -> NDArray[Any]:
    """Readings every 5 s until now."""
    times_s = NOW_S - np.arange(length_s, -1.0, -5.0)
    return np.stack((times_s, np.broadcast_to(value, times_s.shape)))


def look_times(count: int = 6) -> NDArray[Any]:
    return NOW_S - 120.0 * np.arange(count)[::-1]


def looks(moved_px: NDArray[np.float64], count: int = 6) -> NDArray[Any]:
    """Looks every 2 min until now that see the image at `moved_px` (n, 4)."""
    return np.column_stack((look_times(count), moved_px, np.full(count, LOOK_PX)))


AT_REST = SettlingData(chamber=polls(30.02), camera=polls(48.25), digit_K=0.25, looks=looks(np.zeros((6, 4))))


def test_a_camera_at_rest_in_a_chamber_at_its_set_point_is_settled():
    verdict = judge_settling(AT_REST, SOAK, NOW_S)
    assert verdict.settled
    assert verdict.missing == ""
    assert verdict.rates == "camera +0.000 +- 0.030 K/min, image +0.00 +- 0.26 mpx/min"


@pytest.mark.parametrize(
    ("changed", "missing"),
    [
        ({"chamber": polls(30.6)}, "the chamber was not within 0.5 K of its set-point for 10 min"),
        ({"chamber": polls(30.0, 500.0)}, "the chamber was not within 0.5 K of its set-point for 10 min"),
        ({"chamber": polls(np.nan)}, "the chamber was not within 0.5 K of its set-point for 10 min"),
        ({"chamber": np.empty((2, 0))}, "the chamber was not within 0.5 K of its set-point for 10 min"),
        ({"camera": polls(np.nan)}, "the camera's temperature was not always known"),
        ({"camera": polls(48.0, 500.0)}, "the camera's temperature was not always known"),
        ({"looks": np.empty((0, 6))}, "the target was not seen often enough"),
        ({"looks": looks(np.zeros((5, 4)), 5)}, "the target was not seen often enough"),
        ({"looks": looks(np.zeros((6, 4)))[[0, 2, 4]]}, "the target was not seen often enough"),
        ({"digit_K": 1.0}, "the camera's temperature changes by up to 0.120 K/min"),
    ],
)
def test_what_is_not_known_is_not_settled(changed: dict[str, object], missing: str):
    assert judge_settling(replace(AT_REST, **changed), SOAK, NOW_S).missing == missing


def test_one_reading_outside_the_band_within_the_window_is_enough_but_not_one_before_it():
    chamber = polls(30.0)
    chamber[1, -100] = 29.0
    assert judge_settling(replace(AT_REST, chamber=chamber), SOAK, NOW_S).missing.startswith("the chamber")
    chamber = polls(30.0)
    chamber[1, 0] = 29.0
    assert judge_settling(replace(AT_REST, chamber=chamber), SOAK, NOW_S).settled


def test_a_camera_that_warms_and_an_image_that_moves_are_not_settled():
    warming = polls(48.0 + 0.2 * np.arange(181) * 5.0 / 60.0)
    assert judge_settling(replace(AT_REST, camera=warming), SOAK, NOW_S).missing.startswith(
        "the camera's temperature changes"
    )
    for quantity in range(4):  # along I, along J, growing, turning
        moved = np.zeros((6, 4))
        moved[:, quantity] = -0.003 * 2.0 * np.arange(6)
        verdict = judge_settling(replace(AT_REST, looks=looks(moved)), SOAK, NOW_S)
        assert verdict.missing.startswith("the image moves")
        assert verdict.drift.per_min == pytest.approx(-0.003)


def test_a_drift_that_turns_within_the_window_is_not_at_rest():
    minutes = 2.0 * np.arange(6) - 5.0
    turning = np.zeros((6, 4))
    turning[:, 1] = 0.0005 * minutes**2  # 5 mpx/min at either end, 0 on the whole
    verdict = judge_settling(replace(AT_REST, looks=looks(turning)), SOAK, NOW_S)
    assert not verdict.settled
    assert abs(verdict.drift.per_min) == pytest.approx(0.005)


def test_the_drift_is_the_largest_in_the_window():
    """An exponential of 20 min is e^(1/2) faster at the window's begin than at its end; the parabola follows it."""
    minutes = 2.0 * np.arange(6)
    moved = np.zeros((6, 4))
    moved[:, 0] = -0.1 * np.exp(-minutes / 20.0)
    assert fit_drift_rate(np.float64(60.0) * minutes, moved, np.full(6, LOOK_PX)).per_min == pytest.approx(
        0.1 / 20.0, rel=0.03
    )


def test_the_uncertainty_of_the_drift_is_that_of_its_scatter():
    draw = np.random.default_rng(3)
    times_s, known = 120.0 * np.arange(6, dtype=np.float64), np.full(6, LOOK_PX)
    found = [fit_drift_rate(times_s, draw.normal(0.0, LOOK_PX, (6, 1)), known) for _ in range(4000)]
    exceeding = np.mean([abs(rate.per_min) > 2.0 * rate.uncertainty for rate in found])
    assert 0.02 < exceeding < 0.10  # of the larger of two ends, 95 % each
    vibrating = [fit_drift_rate(times_s, draw.normal(0.0, 10 * LOOK_PX, (6, 1)), known) for _ in range(1000)]
    assert (
        5.0
        < np.median([rate.uncertainty for rate in vibrating]) / np.median([rate.uncertainty for rate in found])
        < 11.0
    )


def test_few_looks_and_few_readings_say_nothing():
    assert np.isnan(fit_drift_rate(np.arange(3.0), np.zeros((3, 4)), np.ones(3)).bound)
    assert np.isnan(fit_camera_rate(np.zeros((2, 2)), 0.25).bound)
    assert np.isnan(Rate().bound)


@pytest.mark.parametrize("true_K_per_min", [0.0, 0.01, 0.03, 0.06, -0.1])
def test_rounding_to_digits_is_within_the_uncertainty(true_K_per_min: float):
    inside = []
    for start_K in np.linspace(40.0, 40.25, 50, endpoint=False):
        truth = start_K + true_K_per_min * np.arange(121) * 5.0 / 60.0
        shown = polls(np.round(truth / 0.25) * 0.25, 600.0)
        inside.append(
            abs(fit_camera_rate(shown, 0.25).per_min - true_K_per_min) <= 2.0 * fit_camera_rate(shown, 0.25).uncertainty
        )
    assert np.mean(inside) >= 0.94


def test_the_digit_is_the_smallest_step_seen():
    assert find_digit_K(np.array([40.0, 40.0, 40.25, 40.75, np.nan, 40.5])) == pytest.approx(0.25)
    assert find_digit_K(np.array([40.0, 40.0])) == 0.0
    assert find_digit_K(np.array([])) == 0.0


def detection(centres_px: NDArray[Any]) -> Detection:
    count = len(centres_px)
    return Detection(
        centres_px=centres_px,
        covariance_px2=np.broadcast_to(0.0025**2 * np.eye(2), (count, 2, 2)),
        flags=np.zeros(count, np.uint8),
        chi=np.ones(count),
        homography=np.eye(3),
        growth=np.ones(2),
        excess_px2=np.zeros(2),
        band_sigma=9.0,
        is_suspect=False,
        state=EdgeState(np.zeros((count, 12)), np.ones(count)),
    )


GRID_PX = np.stack(np.meshgrid(300.0 + 260.0 * np.arange(9), 300.0 + 260.0 * np.arange(6)), axis=-1).reshape(-1, 2)
ARM_PX = GRID_PX - GRID_PX.mean(axis=0)
RADIUS_PX = np.sqrt((ARM_PX**2).sum(axis=1).mean())


def test_a_movement_is_taken_apart_into_shift_growth_and_turn():
    moved_px = np.array([0.1, -0.2]) + 2e-5 * ARM_PX + 1e-5 * ARM_PX[:, ::-1] * [-1.0, 1.0]
    seen = measure_movement(detection(GRID_PX), detection(GRID_PX + moved_px))
    assert seen is not None
    assert seen[0] == pytest.approx([0.1, -0.2, 2e-5 * RADIUS_PX, 1e-5 * RADIUS_PX])
    assert seen[1] == pytest.approx(0.0025 / np.sqrt(54))


def test_flagged_markers_do_not_count_and_three_are_too_few():
    now = detection(GRID_PX + 0.1)
    now.centres_px[7] = np.nan
    now.flags[7] = 1
    seen = measure_movement(detection(GRID_PX), now)
    assert seen is not None
    assert seen[0][:2] == pytest.approx([0.1, 0.1])
    now.flags[3:] = 1
    assert measure_movement(detection(GRID_PX), now) is None
