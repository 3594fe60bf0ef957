import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.clock import seconds_ns
from stand.compressor import CompressorLimits, CompressorState, decide

LIMITS = CompressorLimits(
    min_off_s=300, min_on_s=180, max_starts_per_h=6, start_above_cool_percent=20, stop_above_heat_percent=60
)


def test_it_rests_for_the_minimum_off_time_after_a_restart_of_the_daemon():
    state = CompressorState(running=False, since_ns=0)
    assert not decide(state, LIMITS, 0.0, 100.0, seconds_ns(299)).running
    assert decide(state, LIMITS, 0.0, 100.0, seconds_ns(300)).running


def test_it_runs_on_while_the_heater_trims_and_stops_when_it_works_hard_against_it():
    state = CompressorState(running=True, since_ns=0)
    assert decide(state, LIMITS, 40.0, 0.0, seconds_ns(1000)).running
    assert decide(state, LIMITS, 90.0, 0.0, seconds_ns(179)).running
    assert not decide(state, LIMITS, 90.0, 0.0, seconds_ns(180)).running


@pytest.mark.parametrize(("mv_heat", "mv_cool"), [(math.nan, math.nan), (math.nan, 80.0), (0.0, math.nan)])
def test_an_unknown_output_never_starts_it(mv_heat: float, mv_cool: float):
    state = CompressorState(running=False, since_ns=0)
    assert not decide(state, LIMITS, mv_heat, mv_cool, seconds_ns(10_000)).running


@given(st.lists(st.tuples(st.floats(0, 100), st.floats(0, 100)), max_size=400))
def test_whatever_the_regulator_wants_the_compressor_is_spared(outputs: list[tuple[float, float]]):
    state = CompressorState(running=False, since_ns=0)
    switched_ns = [0]
    starts_ns: list[int] = []
    for tick, (mv_heat, mv_cool) in enumerate(outputs):
        now_ns = seconds_ns(10.0 * (tick + 1))
        after = decide(state, LIMITS, mv_heat, mv_cool, now_ns)
        if after.running != state.running:
            rest_s = LIMITS.min_off_s if after.running else LIMITS.min_on_s
            assert now_ns - switched_ns[-1] >= seconds_ns(rest_s)
            switched_ns.append(now_ns)
            if after.running:
                starts_ns.append(now_ns)
                assert sum(start > now_ns - seconds_ns(3600) for start in starts_ns) <= LIMITS.max_starts_per_h
        state = after
