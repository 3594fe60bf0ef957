"""The PID law against its formula, against continuous control theory (scipy), and what limits do to it."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermostand.drivers.devices.regulators import pid
from thermostand.drivers.devices.regulators.pid import Law

PLAIN = Law(
    gain_percent_per_K=10,
    integral_s=100,
    derivative_s=0,
    set_point_weight=1,
    approach_s=None,
    lowest_percent=-100,
)


@pytest.mark.parametrize(
    ("b", "c", "derivative_s"), [(1.0, 0.0, 0.0), (0.0, 0.0, 20.0), (0.5, 0.0, 20.0), (0.3, 1.0, 20.0)]
)
def test_a_small_step_of_the_set_point_follows_the_continuous_law(b: float, c: float, derivative_s: float):
    """G = 0.5 K/% / (60 s + 1) under u = K (b r - y + (r - y) / (Ti s) + Td s (c r - y) / (1 + Td s / N)): the closed
    loop's step response by lsim. Sampled at Ti / 500, so that the discretization does not count."""
    from scipy.signal import TransferFunction, lsim  # a second of processor time, in each worker that collects it

    K, Ti, N, h_s = 10.0, 100.0, 8.0, 0.2
    law = PLAIN.model_copy(
        update={"derivative_s": derivative_s, "set_point_weight": b, "derivative_set_point_weight": c}
    )
    lag = np.array([derivative_s / N, 1.0])  # everything is multiplied by Ti s (1 + Td s / N)
    from_r = K * np.polyadd(np.polymul([b * Ti, 1.0], lag), [c * derivative_s * Ti, 0.0, 0.0])
    from_y = K * np.polyadd(np.polymul([Ti, 1.0], lag), [derivative_s * Ti, 0.0, 0.0])
    plant, below = 0.5, np.polymul([60.0, 1.0], np.polymul([Ti, 0.0], lag))
    above = np.trim_zeros(plant * from_r, "f")
    closed = TransferFunction(above, np.trim_zeros(np.polyadd(below, plant * from_y), "f"))
    times = np.arange(0.0, 600.0, h_s)
    _, expected, _ = lsim(closed, np.ones_like(times), times)

    state, y, decay, measured = pid.start(law, 0.0, 0.0), 0.0, math.exp(-h_s / 60), list[float]()
    for _ in times:
        measured.append(y)
        output, state = pid.step(law, state, 1.0, y, h_s)
        y = y * decay + plant * output * (1 - decay)  # exact for an output that is held
    assert np.abs(np.array(measured) - expected).max() < 0.01


def test_one_step_is_the_formula():
    law = PLAIN.model_copy(update={"derivative_s": 20.0, "set_point_weight": 0.5})
    state = pid.State(set_point_degC=30.0, integral_percent=7.0, derivative_percent=-2.0, weighed_K=28.0)
    output, after = pid.step(law, state, 30.0, 28.5, 5.0)
    derivative = 20 / (20 + 8 * 5) * -2.0 - 10 * 20 * 8 / (20 + 8 * 5) * 0.5
    assert output == pytest.approx(max(-100.0, 10 * (15.0 - 28.5) + 7.0 + derivative))
    assert after.derivative_percent == pytest.approx(derivative)


def test_it_starts_with_the_output_it_is_given_without_a_bump():
    law = PLAIN.model_copy(update={"derivative_s": 20.0, "approach_s": 400.0})
    output, _ = pid.step(law, pid.start(law, 33.0, 42.0), 33.0, 33.0, 5.0)
    assert output == pytest.approx(42.0)


def test_a_new_set_point_makes_no_jump_when_it_is_approached():
    law = PLAIN.model_copy(update={"approach_s": 400.0})
    output, _ = pid.step(law, pid.start(law, 20.0, 10.0), 45.0, 20.0, 5.0)
    assert output == pytest.approx(10.0 + 10 * 25 * (1 - math.exp(-5 / 400)))


def test_after_a_gap_the_integral_is_as_it_was_and_the_derivative_does_not_kick():
    law = PLAIN.model_copy(update={"derivative_s": 20.0})
    state = pid.State(30.0, 15.0, 3.0, 29.0)
    output, _ = pid.step(law, pid.continue_after_gap(law, state, 25.0), 30.0, 25.0, 5.0)
    assert output == pytest.approx(10 * (30 - 25) + 15.0)


def test_back_calculation_keeps_the_demand_by_tracking_times_error_above_its_limit():
    """I stands still where K h / Ti e = h / Tt (v - u): v = u + Tt / Ti K e (Astrom and Hagglund 3.5)."""
    law = PLAIN.model_copy(update={"tracking_s": 50.0})
    output, state = 0.0, pid.start(law, 20.0, 0.0)
    for _ in range(2000):
        output, state = pid.step(law, state, 45.0, 20.0, 1.0)
    assert output == 100.0
    demand = 10 * (45 - 20) + state.integral_percent
    assert demand == pytest.approx(100 + 50 / 100 * 10 * 25, rel=1e-3)


def test_its_own_set_point_waits_while_the_output_is_at_its_limit():
    """Else it would be there before a cold that takes an hour, and the integral charged."""
    law = PLAIN.model_copy(update={"approach_s": 100.0, "lowest_percent": -15.0})
    state = pid.start(law, 45.0, 10.0)
    for _ in range(1000):
        _, state = pid.step(law, state, 10.0, 45.0, 5.0)
    assert 35 < state.set_point_degC < 45


def test_the_rate_of_the_set_point_is_limited():
    law = PLAIN.model_copy(update={"set_point_K_per_min": 2.0})
    _, state = pid.step(law, pid.start(law, 20.0, 50.0), 45.0, 20.0, 30.0)
    assert state.set_point_degC == pytest.approx(21.0)


@given(
    measured=st.lists(st.floats(-40, 100), min_size=1, max_size=30),
    asked=st.floats(-10, 60),
    h_s=st.floats(0.1, 600),
)
def test_whatever_is_measured_the_output_is_within_its_limits(measured: list[float], asked: float, h_s: float):
    law = Law(derivative_s=30, lowest_percent=-15, highest_percent=80)
    state = pid.start(law, measured[0], 0.0)
    for degC in measured:
        output, state = pid.step(law, state, asked, degC, h_s)
        assert -15 <= output <= 80
        assert all(map(math.isfinite, (state.set_point_degC, state.integral_percent, state.derivative_percent)))
    assert replace(state) == state


@pytest.mark.parametrize(
    ("output", "dead_band", "expected"),
    [
        (100, 0, (100, 0)),
        (-100, 10, (0, 100)),
        (50, 0, (50, 0)),
        (4, 10, (0, 0)),
        (-5, 10, (0, 0)),
        (52.5, 10, (50, 0)),
        (0, 0, (0, 0)),
    ],
)
def test_heat_and_cold_share_the_range_and_never_fight(output: float, dead_band: float, expected: tuple[float, float]):
    assert pid.split(output, dead_band) == pytest.approx(expected)
