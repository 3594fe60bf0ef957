"""A session that decides: what is foreseen of a camera, what is chosen to be visited, and when enough is known."""

from dataclasses import replace

import numpy as np
import pytest

from thermostand.compensation.design.next_visit import (
    CameraSurroundings,
    Decision,
    DesignGoal,
    DesignState,
    ForecastState,
    compute_equilibrium,
    decide,
    find_best_course,
    fit_surroundings,
    forecast,
    list_wanted_states,
    read_current_state,
)
from thermostand.compensation.drift.training_data import compute_frame_states
from thermostand.compensation.expression import AIR, CAMERA, backlash, lag
from thermostand.compensation.history.thermal_history import Float, ThermalStateSpec
from thermostand.compensation.observations import Observations

from .drawn_cameras import draw_camera
from .drawn_sessions import Stretch, record_session, reference, warm_up

WANTED = DesignGoal((10.0, 52.0), 0.005, held_out_degC=(20.0, 34.0))
AIR_LAGS = [lag(AIR, tau_s) for tau_s in (480.0, 3000.0)]
CAMERA_LAGS = [lag(CAMERA, tau_s) for tau_s in (480.0, 3000.0)]
MEMORY = ThermalStateSpec((*AIR_LAGS, *CAMERA_LAGS, backlash(CAMERA, 5.0)))
BEGUN = [*warm_up(), *reference()]
VISITS = [Stretch(degC, 1500, "fit", 5) for degC in (52.0, 10.0, 45.0, 17.0, 31.0)]


@pytest.fixture(scope="module")
def observed() -> Observations:
    return record_session(draw_camera(3), [*BEGUN, *VISITS]).observed


def up_to(observed: Observations, frames: int) -> Observations:
    """As if the session had only so many frames so far."""
    columns = {
        name: getattr(observed, name)[:frames]
        for name in ("session", "frame", "time_ns", "role", "step_id", "chamber_degC", "camera_degC", "air_degC")
    }
    centres = {name: getattr(observed, name)[:frames] for name in ("centres_px", "covariance_px2", "flags", "reasons")}
    return replace(observed, **columns, **centres)


def test_camera_and_lags_are_foreseen(observed: Observations):
    before = up_to(observed, len(observed.frame) - 5)
    around = fit_surroundings(before, ramp_K_per_min=20.0)
    foreseen = forecast(around, read_current_state(before, MEMORY), np.array([31.0]), np.array([1500.0])).states
    came = compute_frame_states(observed, MEMORY).where(np.array([len(observed.frame) - 1]))
    assert foreseen.camera_degC == pytest.approx(came.camera_degC, abs=0.5)
    assert foreseen.of(AIR_LAGS)[0] == pytest.approx(came.of(AIR_LAGS)[0], abs=0.5)
    assert foreseen.of(CAMERA_LAGS)[0] == pytest.approx(came.of(CAMERA_LAGS)[0], abs=0.5)


def test_a_long_dwell_comes_to_rest(observed: Observations):
    around = fit_surroundings(observed, ramp_K_per_min=2.0)
    begun = compute_equilibrium(around, np.array([10.0, 50.0]), MEMORY)
    rest = compute_equilibrium(around, np.array([40.0, 40.0]), MEMORY).states
    long = forecast(around, begun, np.array([40.0, 40.0]), np.full(2, 12 * 3600.0)).states
    assert long.camera_degC == pytest.approx(rest.camera_degC, abs=0.01)
    assert long.of(AIR_LAGS) == pytest.approx(rest.of(AIR_LAGS), abs=0.01)
    assert long.of([backlash(CAMERA, 5.0)])[:, 0] - long.camera_degC == pytest.approx([-5.0, 5.0], abs=0.01)


def test_the_ends_of_the_range_teach_most_about_a_straight_line():
    around = CameraSurroundings(np.array([0.0, 1.0]), np.array([15.0, 1.0, 0.0, 0.0, 0.0, 0.0]), 20.0)
    here = compute_equilibrium(around, np.array([24.0]), MEMORY)

    def line(situation: ForecastState) -> Float:
        return np.column_stack([np.ones(len(situation.air_degC)), (situation.air_degC - 31.0) / 20.0])

    wanted = np.column_stack([np.ones(9), np.linspace(-1.0, 1.0, 9)])
    known = DesignState(np.diag([1e-8, 1e-4]), 1e-6, wanted, line)
    chosen = find_best_course(known, here, around, np.linspace(10.0, 52.0, 13), (14400.0,), seed=1)
    assert chosen.chamber_degC in (10.0, 52.0)
    assert chosen.variance_px2 < 1e-8 + 1e-4 / 20


def test_a_part_that_creeps_is_shown_by_staying():
    """At the end of eight hours at one end of the range it has gone further than on any way to and fro."""
    around = CameraSurroundings(np.array([0.0, 1.0]), np.array([15.0, 1.0, 0.0, 0.0, 0.0, 0.0]), 20.0)
    here = compute_equilibrium(around, np.array([31.0]), ThermalStateSpec((lag(AIR, 20000.0),)))

    def creep(situation: ForecastState) -> Float:
        return (situation.states.of([lag(AIR, 20000.0)]) - 31.0) / 20.0

    known = DesignState(np.array([[1e-4]]), 1e-4, np.array([[1.0]]), creep)
    chosen = find_best_course(known, here, around, np.linspace(10.0, 52.0, 13), (7200.0,), seed=1)
    stayed = np.cumsum([7200.0] * 4)
    gone = [float(creep(forecast(around, here, np.array([52.0]), np.array([time_s])))[0, 0]) for time_s in stayed]
    assert chosen.chamber_degC in (10.0, 52.0)
    assert chosen.variance_px2 == pytest.approx(1 / (1e4 + sum(np.square(gone)) / 1e-4), rel=0.01)


def test_states_at_rest_are_nearer_to_the_chamber_than_those_on_the_way(observed: Observations):
    around = fit_surroundings(observed, ramp_K_per_min=2.0)
    away_K = {}
    for kind in ("at_rest", "on_the_way"):
        states = list_wanted_states(around, MEMORY, (10.0, 52.0), (kind,)).states
        places = around.air_degC(np.tile(np.linspace(10.0, 52.0, 7), 3))
        away_K[kind] = float(np.abs(states.of(AIR_LAGS)[:, 1] - places).max())
    assert away_K["at_rest"] < 0.5 < 5.0 < away_K["on_the_way"]
    both = list_wanted_states(around, MEMORY, (10.0, 52.0), ("at_rest", "on_the_way"))
    assert len(both.air_degC) == len(both.states.camera_degC) == 42


@pytest.fixture(scope="module")
def decided(observed: Observations) -> Decision:
    return decide(observed, WANTED)


def test_decisions_are_the_same_for_the_same_frames_and_stay_within_what_is_wanted(
    observed: Observations, decided: Decision
):
    assert decide(observed, WANTED) == decided
    assert decided.kind == "visit"
    assert 10.0 <= decided.chamber_degC <= 52.0
    assert min(abs(decided.chamber_degC - degC) for degC in WANTED.held_out_degC) >= 1.0
    assert decided.soak_s in WANTED.soaks_s


def test_without_a_model_what_is_furthest_is_visited(observed: Observations):
    first = decide(up_to(observed, 80), WANTED)
    assert (first.kind, first.chamber_degC) == ("visit", 52.0)
    assert np.isnan(first.predicted_px)


def test_what_is_left_between_set_points_is_looked_at_before_the_session_goes_on(observed: Observations):
    """After 52 and 10 degC only the reference lies between others: what a form leaves there cannot be reported from how
    it extrapolates, and more at the ends would not change that."""
    begun = up_to(observed, 90)
    predicted_px = decide(begun, WANTED).predicted_px
    decision = decide(begun, replace(WANTED, residual_px=0.95 * predicted_px))
    assert decision.reason.startswith("what the model leaves")
    assert decision.chamber_degC == 38.0


def test_enough_is_known_when_the_predicted_residual_is_the_wanted_one(observed: Observations, decided: Decision):
    for share, kind in ((1.01, "enough"), (0.99, "visit")):
        assert decide(observed, replace(WANTED, residual_px=share * decided.predicted_px)).kind == kind
