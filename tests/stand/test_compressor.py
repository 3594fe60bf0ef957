import math
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.clock import seconds_ns
from stand.guarding.compressor import CompressorLimits, CompressorState, decide, keep, restored

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


NOW_NS = seconds_ns(1_800_000_000)
STARTS_NS = (NOW_NS - seconds_ns(2000), NOW_NS - seconds_ns(700))


def test_what_is_kept_is_restored(tmp_path: Path):
    path = tmp_path / "sessions" / "compressor.json"
    state = CompressorState(False, NOW_NS - seconds_ns(400), STARTS_NS)
    keep(path, CompressorState(True, NOW_NS - seconds_ns(700), STARTS_NS))
    keep(path, state)
    assert restored(path, NOW_NS) == state
    assert os.listdir(path.parent) == ["compressor.json"]


def test_one_that_was_running_was_switched_off_just_now_for_all_that_is_known(tmp_path: Path):
    keep(tmp_path / "file", CompressorState(True, NOW_NS - seconds_ns(700), STARTS_NS))
    assert restored(tmp_path / "file", NOW_NS) == CompressorState(False, NOW_NS, STARTS_NS)


def test_the_future_is_ignored(tmp_path: Path):
    """The host's clock was wrong then, or is now."""
    keep(tmp_path / "file", CompressorState(False, NOW_NS + 1, (*STARTS_NS, NOW_NS + 1)))
    assert restored(tmp_path / "file", NOW_NS) == CompressorState(False, NOW_NS, STARTS_NS)


@pytest.mark.parametrize(
    "content",
    [
        None,
        b"",
        b"{",
        b"null",
        b"[]",
        b'{"running": false}',
        b'{"running": 0, "since_ns": "x", "starts_ns": []}',
        b"\xff",
    ],
)
def test_a_missing_or_damaged_file_means_switched_off_just_now(tmp_path: Path, content: bytes | None):
    path = tmp_path / "compressor.json"
    if content is not None:
        path.write_bytes(content)
    assert restored(path, NOW_NS) == CompressorState(False, NOW_NS)


def test_without_a_file_nothing_is_kept():
    keep(None, CompressorState(False, 5))
    assert restored(None, NOW_NS) == CompressorState(False, NOW_NS)


def test_a_folder_that_cannot_be_written_is_told(tmp_path: Path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OSError, match="file"):
        keep(tmp_path / "file" / "compressor.json", CompressorState(False, 5))
