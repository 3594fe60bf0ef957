"""What a camera remembers: exact lags and plays, cold and warm starts, gaps, and the same state sample by sample."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from thermostand.compensation.drift_runtime import ThermalState
from thermostand.compensation.expression import AIR, CAMERA, POWER, backlash, lag
from thermostand.compensation.history.thermal_history import (
    States,
    ThermalHistory,
    ThermalStateSpec,
    compute_states_at,
    make_initial_state,
    read_state_row,
    refine_temperature,
)

S = 1_000_000_000
TAUS_S = (600.0, 3600.0)
AIR_LAGS, POWER_LAGS, CAMERA_LAGS = ([lag(of, tau_s) for tau_s in TAUS_S] for of in (AIR, POWER, CAMERA))
PLAY = backlash(CAMERA, 2.0)
MEMORY = ThermalStateSpec((*AIR_LAGS, *POWER_LAGS, *CAMERA_LAGS, PLAY), 20.0)
STEP_AT_S, END_S = 3600, 4 * 3600


def history(
    camera_excess_K: float = 20.0, gap: tuple[int, int] | None = None, resolution_K: float = 0.0, on_at_s: int = 0
) -> ThermalHistory:
    """The air steps from 24 to 34 degC after an hour, the camera follows at once with its excess."""
    times_s = np.arange(0, END_S + 1, 5)
    if gap is not None:
        times_s = times_s[(times_s < gap[0]) | (times_s > gap[1])]
    air = np.where(times_s > STEP_AT_S, 34.0, 24.0)
    stated = air + camera_excess_K
    if resolution_K:
        stated = resolution_K * np.round(stated / resolution_K)
    on = times_s >= on_at_s
    powered_ns, powered = np.array([0, on_at_s], np.int64) * S, np.array([float(on_at_s == 0), 1.0])
    return ThermalHistory(times_s * S, air, powered_ns, powered, times_s[on] * S, stated[on])


def at(record: ThermalHistory, *seconds: int, camera_degC: float = 54.0) -> States:
    times_ns = np.array(seconds, np.int64) * S
    return compute_states_at(record, MEMORY, times_ns, np.full(len(times_ns), camera_degC))


@pytest.mark.parametrize("after_s", [600, 1800, 7200])
def test_a_lag_follows_a_step_as_the_exponential_does(after_s: int):
    found = at(history(), STEP_AT_S + after_s)
    for column, tau_s in enumerate(TAUS_S):
        expected = 34 - 10 * np.exp(-after_s / tau_s)
        assert found.of(AIR_LAGS)[0, column] == pytest.approx(expected, abs=0.05)  # the step takes 5 s
        assert found.of(CAMERA_LAGS)[0, column] == pytest.approx(expected + 20, abs=0.06)
    assert found.of(POWER_LAGS)[0].tolist() == [1.0, 1.0]
    assert found.of([PLAY])[0, 0] == pytest.approx(52.0)  # 2 K behind 54 degC


def test_states_that_are_asked_for_again_are_kept_and_those_of_anything_else_are_not():
    record = history()
    first = at(record, 1800, 5400)
    with pytest.raises(ValueError, match="read-only"):
        first.camera_degC[0] = 0.0
    assert np.shares_memory(first.rows, at(record, 1800, 5400).rows)
    assert at(record, 1800, 5400, camera_degC=60.0).of([PLAY])[1, 0] == pytest.approx(58.0)  # 2 K behind
    assert at(record, 1800, 7200).of(AIR_LAGS)[1, 0] > first.of(AIR_LAGS)[1, 0] + 0.1
    warmer = replace(record, ambient_degC=record.ambient_degC + 1)
    assert at(warmer, 1800, 5400).of(AIR_LAGS)[0, 0] == pytest.approx(25.0)


def test_a_part_between_air_and_camera_has_plays_of_its_own():
    """Switched on, the chip is 20 K warmer and the part 0.3 of that; its play is left 2 K behind, and behind 54 degC of
    the air when all has settled there."""
    air, camera = AIR_LAGS[0], CAMERA_LAGS[0]
    state = ThermalState((air, camera, PLAY, backlash(air + 0.3 * (camera - air), 2.0)), 20.0)
    state.advance(10.0, 24.0, 1.0, 24.0)
    assert state.values[-2:] == [24.0, 24.0]
    for _ in range(2000):
        state.advance(10.0, 24.0, 1.0, 44.0)
    assert state.values[-2:] == pytest.approx([42.0, 28.0], abs=1e-6)
    for _ in range(2000):
        state.advance(10.0, 54.0, 1.0, 74.0)
    assert state.values[-2:] == pytest.approx([72.0, 58.0], abs=1e-6)


def test_a_warm_start_is_a_guess_and_a_cold_one_is_known():
    warm = at(history(), 1800)
    assert warm.settled_s[0] == pytest.approx(1800)
    assert warm.on_s[0] == np.inf
    cold = at(history(camera_excess_K=0.5), 1800, camera_degC=24.5)
    assert cold.settled_s[0] == np.inf
    assert cold.on_s[0] == pytest.approx(1800)
    np.testing.assert_allclose(cold.of(POWER_LAGS)[0], -np.expm1(-1800 / np.array(TAUS_S)), rtol=1e-9)
    half = at(history(camera_excess_K=10.0), 0 + 10, camera_degC=34.0)
    np.testing.assert_allclose(half.of(POWER_LAGS)[0], 0.5, atol=0.02)


@pytest.mark.parametrize(("stated_degC", "known"), [(21.0, True), (27.0, False)])
def test_a_camera_that_is_as_cold_as_the_air_when_it_is_switched_on_was_in_equilibrium(stated_degC: float, known: bool):
    state = make_initial_state(MEMORY)
    for _ in range(100):
        state.advance(10.0, 20.0, 0.0, math.nan)
    assert state.settled_s == 1000.0
    state.advance(10.0, 20.0, 1.0, stated_degC)
    assert state.settled_s == (math.inf if known else 1010.0)


def test_a_camera_that_was_on_before_and_is_cold_after_a_pause_is_known_no_better():
    state = make_initial_state(MEMORY)
    state.advance(10.0, 20.0, 1.0, 40.0)
    for _ in range(600):
        state.advance(10.0, 20.0, 0.0, math.nan)
    state.advance(10.0, 20.0, 1.0, 20.5)
    assert state.settled_s == 6020.0


def test_power_counts_from_the_instant_it_came_on():
    found = at(history(on_at_s=1803), 1803 + 600, camera_degC=44.0)
    np.testing.assert_allclose(found.of(POWER_LAGS)[0], -np.expm1(-600 / np.array(TAUS_S)), rtol=1e-4)
    assert found.on_s[0] == pytest.approx(600)


def test_after_a_gap_the_state_is_a_guess_again():
    gap = (5000, 7000)
    before, during, after = (at(history(gap=gap), second) for second in (4990, 6000, 7600))
    assert before.settled_s[0] == pytest.approx(4990)
    assert np.isnan(during.settled_s[0])
    assert np.isnan(during.of(AIR_LAGS)).all()
    assert during.camera_degC[0] == 54.0  # the frame itself tells it
    assert 580 < after.settled_s[0] <= 600
    np.testing.assert_allclose(after.of(AIR_LAGS), 34.0)  # as in equilibrium
    short = at(history(gap=(5000, 5100)), 7600)
    assert short.settled_s[0] == pytest.approx(7600)


def test_samples_one_by_one_give_the_same_state_as_the_recording():
    record = history()
    state = make_initial_state(MEMORY)
    for second in range(10, 6001, 10):
        air = [24.0 if edge <= STEP_AT_S else 34.0 for edge in (second - 10, second)]
        state.advance(10.0, sum(air) / 2, 1.0, air[1] + 20.0)
    np.testing.assert_allclose(read_state_row(state), at(record, 6000).rows[0], rtol=1e-9)
    assert state.camera_degC == 54.0


def test_before_the_record_and_without_one_only_the_camera_is_known():
    late_ns, nothing_ns = np.array([5000, 5005], np.int64) * S, np.empty(0, np.int64)
    late = ThermalHistory(late_ns, np.full(2, 24.0), late_ns, np.full(2, 24.0), late_ns, np.full(2, 24.0))
    empty = ThermalHistory(nothing_ns, np.empty(0), nothing_ns, np.empty(0), nothing_ns, np.empty(0))
    for record in (late, empty):
        found = at(record, 100)
        assert found.camera_degC[0] == 54.0
        assert np.isnan(found.of(AIR_LAGS)).all()
        assert np.isnan(found.settled_s).all()


def test_a_display_in_quarters_is_refined_between_its_steps():
    times_s = np.arange(0, 10_000, 5)
    true = 24 + 18 * -np.expm1(-times_s / 700) + 2 * -np.expm1(-times_s / 3000)
    stated = 0.25 * np.round(true / 0.25)
    powered_ns = np.array([0], np.int64)
    record = refine_temperature(
        ThermalHistory(times_s * S, np.full(len(times_s), 24.0), powered_ns, np.ones(1), times_s * S, stated)
    )
    assert record.resolution_K == 0.25
    error = record.camera_degC - true
    assert np.std(stated - true) > 0.06
    assert np.std(error) < 0.02
    assert np.abs(record.camera_degC - stated).max() <= 0.125 + 1e-9
    fine = ThermalHistory(times_s * S, np.full(len(times_s), 24.0), powered_ns, np.ones(1), times_s * S, true)
    np.testing.assert_array_equal(refine_temperature(fine).camera_degC, true)


def test_a_play_stays_until_it_is_pushed_from_either_side():
    state = ThermalState((backlash(CAMERA, 1.0), backlash(CAMERA, 3.0)), 20.0)
    places: list[list[float]] = []
    for camera_degC in (0.0, 0.5, 5.0, 3.5, -2.0):
        state.advance(10.0, 0.0, 1.0, camera_degC)
        places.append(state.values[-2:])
    assert places[1:] == [[0, 0], [4, 2], [4, 2], [-1, 1]]
