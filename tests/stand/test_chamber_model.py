"""The chamber's model, learned from recorded ramps of a chamber that is known."""

import math
from pathlib import Path

import numpy as np
import pytest

from tests.recording.full_session import record
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.items import Batch, StepMark, StepState
from thermostand.foundation.readings import Reading, bad_reading
from thermostand.recording.reading.session import Session
from thermostand.stand.estimating.chamber_model import (
    BAND_K,
    ChamberModel,
    Ramp,
    Response,
    extract_ramps,
    fit_chamber_model,
)

HEATING = Response(dead_s=20.0, rate_K_per_s=0.04, time_constant_s=90.0)
COOLING = Response(dead_s=70.0, rate_K_per_s=0.012, time_constant_s=150.0)
CAMERA_S = 700.0
SET_POINTS_degC = (24.0, 31.0, 45.0, 52.0, 38.0, 37.0, 20.0)
DWELL_S = 2400
POLL_S = 15


def followed(set_points_degC: tuple[float, ...], soak_s: int) -> tuple[np.ndarray, np.ndarray]:
    """Air and camera each second, integrated: the truth, written down without the model's solution."""
    air, camera = [24.0], [44.0]
    for set_point_degC in set_points_degC:
        response = HEATING if set_point_degC > air[-1] else COOLING
        for second in range(soak_s):
            wanted = (set_point_degC - air[-1]) / response.time_constant_s
            rate = max(-response.rate_K_per_s, min(response.rate_K_per_s, wanted))
            air.append(air[-1] + (rate if second >= response.dead_s else 0.0))
            camera.append(camera[-1] + (air[-1] + 20.0 - camera[-1]) / CAMERA_S)
    return np.array(air), np.array(camera)


def ramp(from_degC: float, to_degC: float, camera_time_constant_s: float = math.nan) -> Ramp:
    response = HEATING if to_degC > from_degC else COOLING
    gap_K = abs(to_degC - from_degC)
    arrivals = ((level_K, response.arrival_s(gap_K, level_K)) for level_K in (4.0, 2.0, 1.0, BAND_K))
    return Ramp(from_degC, to_degC, tuple(pair for pair in arrivals if pair[0] < gap_K), camera_time_constant_s)


async def recorded(directory: Path) -> Session:
    """The truth above as a session: digits of 0.1 K, a poll each 15 s, one of them BAD."""
    air, camera = followed(SET_POINTS_degC, DWELL_S)

    def items(time_ns: int, index: int):
        second = index * POLL_S
        dwell, into_s = divmod(second, DWELL_S)
        pv = Reading("regulator.pv", round(float(air[second]), 1), "degC", time_ns)
        yield Batch(
            "regulator", time_ns, (bad_reading("regulator.pv", "degC", time_ns, "break") if index == 77 else pv,)
        )
        sensor_degC = round(float(camera[second]) * 4) / 4
        yield Batch("camera", time_ns, (Reading("camera.temperature", sensor_degC, "degC", time_ns),))
        if into_s == 0:
            parameters: dict[str, object] = {"chamber_degC": SET_POINTS_degC[dwell]}
            for state in (StepState.STARTED, StepState.DONE):
                yield StepMark(time_ns, f"step-{dwell}", 2 * dwell, "set_temperature", state, parameters)

    count = len(SET_POINTS_degC) * DWELL_S // POLL_S
    await record(directory, count, items, segment_s=1e6, period_ns=POLL_S * NS_PER_S)
    return Session.open(directory)


@pytest.mark.parametrize("gap_K", [0.6, 3.0, 7.0, -28.0])
def test_the_arrival_is_that_of_the_integrated_equation(gap_K: float):
    air, _ = followed((24.0 + gap_K,), 6000)
    arrival_s = int(np.flatnonzero(np.abs(air - 24.0 - gap_K) <= BAND_K)[0])
    response = HEATING if gap_K > 0 else COOLING
    assert response.arrival_s(gap_K) == pytest.approx(arrival_s, abs=3.0)


def test_within_the_band_nothing_is_waited_for():
    assert HEATING.arrival_s(0.5) == 0.0
    assert ChamberModel().settled_s(24.0, 24.3) == 0.0


def test_the_camera_follows_for_two_time_constants():
    model = ChamberModel(heating=HEATING, camera_time_constant_s=700.0)
    assert model.settled_s(24.0, 31.0) == pytest.approx(HEATING.arrival_s(7.0) + 1400.0)


async def test_a_recorded_session_teaches_both_directions_and_the_camera(tmp_path: Path):
    session = await recorded(tmp_path / "cycle")
    model = fit_chamber_model(extract_ramps(session))
    assert (model.heating_ramps, model.cooling_ramps, model.camera_ramps) == (3, 2, 5)  # 1 K is no ramp
    for gap_K in (7.0, 14.0, 40.0):
        assert model.arrival_s(10.0, 10.0 + gap_K) == pytest.approx(HEATING.arrival_s(gap_K), rel=0.03)
        assert model.arrival_s(52.0, 52.0 - gap_K) == pytest.approx(COOLING.arrival_s(gap_K), rel=0.05)
    assert model.camera_time_constant_s == pytest.approx(CAMERA_S, rel=0.05)


def test_ramps_that_never_ran_at_full_rate_leave_the_rate_as_it_was():
    """With a time constant of 90 s, 2 K ask for 0.022 K/s; 0.04 K/s is never seen."""
    model = fit_chamber_model([ramp(24.0, 26.0), ramp(26.0, 28.0), ramp(28.0, 29.8)])
    default = ChamberModel()
    assert model.heating.rate_K_per_s == pytest.approx(default.heating.rate_K_per_s, rel=0.05)
    assert model.arrival_s(24.0, 26.0) == pytest.approx(HEATING.arrival_s(2.0), rel=0.05)
    assert model.cooling == default.cooling


def test_one_strange_ramp_among_several_changes_little():
    ramps = [ramp(begin_degC, begin_degC - 7.0, 900.0 + begin_degC) for begin_degC in (52.0, 45.0, 38.0, 31.0, 24.0)]
    late = Ramp(17.0, 10.0, tuple((level_K, 4.0 * at_s) for level_K, at_s in ramps[0].arrivals), 3000.0)
    model = fit_chamber_model([*ramps, late])
    assert model.arrival_s(24.0, 17.0) == pytest.approx(COOLING.arrival_s(7.0), rel=0.08)
    assert model.camera_time_constant_s == pytest.approx(900.0 + 41.5, abs=10.0)


def test_nothing_recorded_is_the_default():
    assert fit_chamber_model([]) == ChamberModel()
