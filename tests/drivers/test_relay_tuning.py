"""Autotuning by the relay method, on plants whose ultimate point is known."""

import math

import pytest

from thermostand.drivers.devices.regulators import relay_tuning
from thermostand.drivers.devices.regulators.pid import Law
from thermostand.drivers.devices.regulators.relay_tuning import Tuning, TuningSettings
from thermostand.foundation.clock import to_ns

SETTINGS, LAW = TuningSettings(), Law()
SP_degC = 45.0


def cycled(lags_s: tuple[float, ...], gain_K: float, holding_percent: float, sample_s: float = 1.0) -> Tuning:
    """The experiment on lags in a row that `holding_percent` holds at the set-point, until it is over."""
    nodes, now_s = [SP_degC] * len(lags_s), 0.0
    tuning = relay_tuning.begin(SP_degC, holding_percent, 0)
    while not tuning.failure and relay_tuning.find_ultimate_point(tuning, SETTINGS) is None:
        now_s += sample_s
        before = SP_degC + gain_K * (relay_tuning.output_percent(tuning, SETTINGS, LAW) - 30.0)
        for number, lag_s in enumerate(lags_s):
            nodes[number] += (before - nodes[number]) * -math.expm1(-sample_s / lag_s)
            before = nodes[number]
        tuning = relay_tuning.step(tuning, nodes[-1], to_ns(now_s), SETTINGS, LAW)
    return tuning


@pytest.mark.parametrize("holding_percent", [30.0, 22.0])
def test_three_equal_lags_have_the_ultimate_point_of_the_textbook(holding_percent: float):
    """1 / (1 + s T)^3: Ku = 8 / gain, Tu = 2 pi T / sqrt(3) (the phase of each lag is 60 degrees). A describing
    function is good to some 10 %. The bias that was given may be wrong: it is found."""
    found = relay_tuning.find_ultimate_point(cycled((40.0, 40.0, 40.0), 0.5, holding_percent), SETTINGS)
    assert found is not None
    assert found.ultimate_gain_percent_per_K == pytest.approx(8 / 0.5, rel=0.12)
    assert found.ultimate_period_s == pytest.approx(2 * math.pi * 40 / math.sqrt(3), rel=0.12)


def test_the_rule_is_amigo_for_a_lag_dominated_plant():
    point = relay_tuning.UltimatePoint(30.0, 200.0, 0.4, 10.0)
    law = relay_tuning.tune(LAW.model_copy(update={"highest_percent": 70.0, "tracking_s": 5.0}), point)
    assert (law.gain_percent_per_K, law.integral_s, law.derivative_s) == (9.0, 120.0, 30.0)
    assert (law.highest_percent, law.tracking_s, law.approach_s) == (70.0, None, 600)
    assert Law.model_validate(law.model_dump()) == law


def test_both_levels_stay_within_what_heat_can_give():
    tuning = relay_tuning.begin(SP_degC, 8.0, 0)
    assert relay_tuning.output_percent(tuning, SETTINGS, LAW) == 16.0
    assert relay_tuning.amplitude_percent(95.0, SETTINGS, LAW) == 5.0


@pytest.mark.parametrize(
    ("holding_percent", "measured_degC", "after_s", "text"),
    [
        (1.0, SP_degC, 10.0, "held by an output of 1.0 %"),
        (30.0, SP_degC + 4, 10.0, "more than 3 K from the set-point"),
        (30.0, SP_degC, 7300.0, "no even limit cycle at 45 degC within 7200 s"),
    ],
)
def test_what_cannot_be_tuned_is_reported(holding_percent: float, measured_degC: float, after_s: float, text: str):
    tuning = relay_tuning.begin(SP_degC, holding_percent, 0)
    assert text in relay_tuning.step(tuning, measured_degC, to_ns(after_s), SETTINGS, LAW).failure


def test_a_limit_cycle_within_the_noise_shows_nothing():
    periods = (relay_tuning.Period(100.0, 0.5, 0.06, 20.0),) * 4
    tuning = Tuning(SP_degC, 0, 30.0, is_high=True, periods=periods)
    assert relay_tuning.find_ultimate_point(tuning, SETTINGS) is None
    assert relay_tuning.find_ultimate_point(tuning, SETTINGS.model_copy(update={"hysteresis_K": 0.02})) is not None


def test_what_was_found_can_be_pasted_into_a_stands_file():
    law = relay_tuning.tune(LAW, relay_tuning.UltimatePoint(30.0, 200.0, 0.4, 10.0))
    assert relay_tuning.format_yaml(law) == "law: {gain_percent_per_K: 9, integral_s: 120, derivative_s: 30}"
