"""The 2-DOF PID against closed forms, and against a chamber of known heat capacity and lags."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermostand.drivers.sim.units.regulator import (
    OFF,
    Gains,
    Outputs,
    Side,
    compute_outputs,
    on_time_ns,
    resume,
    start,
    step,
)

SIDE = Side(band_K=3.0, integral_s=180.0, derivative_s=20.0)
GAINS = Gains(heat=SIDE, cool=SIDE)
P_ONLY = Side(band_K=4.0, integral_s=0.0, derivative_s=0.0)
DT_S = 0.5


class Chamber:
    """Air and walls of one heat capacity, a heater with lag, a probe with lag, losses to the laboratory."""

    def __init__(self, capacity_J_K: float, heater_lag_s: float) -> None:
        self.capacity_J_K, self.heater_lag_s = capacity_J_K, heater_lag_s
        self.heater_W, self.air_degC, self.probe_degC = 0.0, 22.0, 22.0

    def integrate(self, on_fraction: float) -> None:
        self.heater_W += (2000 * on_fraction - self.heater_W) * DT_S / self.heater_lag_s
        self.air_degC += (self.heater_W - 10 * (self.air_degC - 22.0)) * DT_S / self.capacity_J_K
        self.probe_degC += (self.air_degC - self.probe_degC) * DT_S / 10


def heat_up(chamber: Chamber, gains: Gains, setpoint_degC: float, duration_s: float) -> list[float]:
    """Air temperatures of a closed loop with a control period of 2 s, one a step."""
    state, temperatures = start(chamber.probe_degC), list[float]()
    for number in range(round(duration_s / DT_S)):
        outputs, state = step(state, setpoint_degC, chamber.probe_degC, DT_S, gains)
        begin_ns, end_ns = number * 500_000_000, (number + 1) * 500_000_000
        chamber.integrate(on_time_ns(begin_ns, end_ns, outputs.heat_pct / 100, 2_000_000_000) / 500_000_000)
        temperatures.append(chamber.air_degC)
    return temperatures


@pytest.mark.parametrize(("capacity_J_K", "heater_lag_s"), [(25e3, 20.0), (25e3, 30.0), (12e3, 25.0), (40e3, 25.0)])
def test_a_step_of_4_K_overshoots_less_than_1_K_and_settles_without_ripple(
    capacity_J_K: float, heater_lag_s: float
) -> None:
    temperatures = heat_up(Chamber(capacity_J_K, heater_lag_s), GAINS, 26.0, 3600)
    assert max(temperatures) < 27.0
    settled = temperatures[-1200:]
    assert max(settled) - min(settled) < 0.2
    assert settled[-1] == pytest.approx(26.0, abs=0.05)


def test_frozen_integral_keeps_a_step_of_30_K_from_overshooting() -> None:
    assert max(heat_up(Chamber(25e3, 25.0), GAINS, 52.0, 3600)) < 52.3


def test_the_set_point_filter_takes_the_overshoot_of_a_plain_pid_away() -> None:
    eager = replace(GAINS, heat=Side(3.0, 100.0, 10.0), alpha=0.0)
    plain = max(heat_up(Chamber(25e3, 25.0), eager, 26.0, 1800)) - 26.0
    filtered = max(heat_up(Chamber(25e3, 25.0), replace(eager, alpha=1.0), 26.0, 1800)) - 26.0
    assert plain > 0.5
    assert filtered < plain / 2


def answer_to_a_disturbance(alpha: float) -> Outputs:
    state, outputs = start(30.0), OFF
    for measured_degC in (30.0, 29.9, 29.7, 29.6):
        outputs, state = step(state, 30.0, measured_degC, DT_S, replace(GAINS, alpha=alpha))
    return outputs


@pytest.mark.parametrize("alpha", [0.65, 1.0])
def test_the_answer_to_a_disturbance_does_not_depend_on_alpha(alpha: float) -> None:
    assert answer_to_a_disturbance(alpha).heat_pct == pytest.approx(answer_to_a_disturbance(0.0).heat_pct)
    assert 0 < answer_to_a_disturbance(alpha).heat_pct < 100


def test_a_plain_p_controller_gives_error_over_band() -> None:
    gains = Gains(heat=P_ONLY, cool=replace(P_ONLY, band_K=2.0), alpha=0.0)
    assert step(start(20.0), 21.0, 20.0, DT_S, gains)[0] == Outputs(25.0, 0.0)
    assert step(start(20.0), 19.0, 20.0, DT_S, gains)[0] == Outputs(0.0, 50.0)
    assert step(start(20.0), 60.0, 20.0, DT_S, gains)[0] == Outputs(100.0, 0.0)


def test_the_integral_of_a_constant_error_grows_by_the_error_every_integral_time() -> None:
    gains = Gains(heat=Side(10.0, 100.0, 0.0), cool=SIDE, alpha=0.0)
    state = start(20.0)
    for _ in range(200):
        _, state = step(state, 21.0, 20.0, DT_S, gains)
    assert state.integral_K == pytest.approx(1.0)


def test_the_derivative_acts_on_the_measurement_and_settles_at_td_times_its_slope() -> None:
    gains = Gains(heat=Side(100.0, 0.0, 20.0), cool=Side(100.0, 0.0, 20.0), alpha=0.0)
    state = start(0.0)
    outputs, state = step(state, 10.0, 0.0, DT_S, gains)
    assert outputs.heat_pct == pytest.approx(10.0)  # no kick from the set point
    for number in range(1, 200):
        measured_degC = 0.01 * number * DT_S
        outputs, state = step(state, 10.0, measured_degC, DT_S, gains)
    assert outputs.heat_pct == pytest.approx(10.0 - measured_degC - 20.0 * 0.01, abs=1e-3)


def approx(heat_pct: float, cool_pct: float) -> Outputs:
    """Equal to outputs that are about that."""
    return Outputs(pytest.approx(heat_pct), pytest.approx(cool_pct))  # pyright: ignore[reportArgumentType]


def test_a_dead_band_is_silent_and_an_overlap_drives_both_sides() -> None:
    gains = Gains(heat=P_ONLY, cool=P_ONLY, dead_band_K=1.0)
    assert compute_outputs(0.4, gains) == compute_outputs(-0.4, gains) == OFF
    assert compute_outputs(0.9, gains) == approx(10.0, 0.0)
    assert compute_outputs(0.0, replace(gains, dead_band_K=-0.8)) == approx(10.0, 10.0)


def test_limits_hold_and_the_integral_does_not_wind_up_behind_them() -> None:
    gains = replace(GAINS, heat=replace(SIDE, limit_pct=40.0), alpha=0.0)
    state = start(20.0)
    for _ in range(1000):
        outputs, state = step(state, 30.0, 20.0, DT_S, gains)
    assert outputs == Outputs(40.0, 0.0)
    assert state.integral_K == 0.0


@given(
    heat_pct=st.floats(0.0, 95.0),
    setpoint_degC=st.floats(-10, 70),
    measured_degC=st.floats(-10, 70),
    cool=st.booleans(),
)
def test_control_resumes_from_manual_without_a_bump(
    heat_pct: float, setpoint_degC: float, measured_degC: float, cool: bool
) -> None:
    manual = Outputs(0.0, heat_pct) if cool else Outputs(heat_pct, 0.0)
    state = resume(manual, setpoint_degC, measured_degC, GAINS)
    outputs, _ = step(state, setpoint_degC, measured_degC, DT_S, GAINS)
    bump_pct = 100 * GAINS.alpha * abs(setpoint_degC - measured_degC) * DT_S / SIDE.integral_s / SIDE.band_K
    assert outputs.heat_pct == pytest.approx(manual.heat_pct, abs=bump_pct + 1e-6)
    assert outputs.cool_pct == pytest.approx(manual.cool_pct, abs=bump_pct + 1e-6)


@pytest.mark.parametrize(
    ("begin_ms", "end_ms", "duty", "on_ms"),
    [
        (0, 500, 0.3, 500),
        (500, 1000, 0.3, 100),
        (1000, 2000, 0.3, 0),
        (1500, 2500, 0.3, 500),
        (0, 20_000, 0.3, 6000),
        (0, 500, 0.0, 0),
        (100, 600, 1.0, 500),
        (100, 600, 1.05, 500),
    ],
)
def test_the_on_window_of_a_2_s_period_is_covered_exactly(begin_ms: int, end_ms: int, duty: float, on_ms: int) -> None:
    assert on_time_ns(begin_ms * 10**6, end_ms * 10**6, duty, 2 * 10**9) == on_ms * 10**6


@given(cut_ns=st.integers(0, 10**11), duty=st.floats(0, 1), period_ns=st.sampled_from([10**8, 2 * 10**9, 99 * 10**9]))
def test_on_times_of_adjoining_spans_add_up(cut_ns: int, duty: float, period_ns: int) -> None:
    whole_ns = on_time_ns(0, 10**11, duty, period_ns)
    assert on_time_ns(0, cut_ns, duty, period_ns) + on_time_ns(cut_ns, 10**11, duty, period_ns) == whole_ns
