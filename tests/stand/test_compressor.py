import math
import os
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermostand.foundation.clock import Boot, to_ns
from thermostand.foundation.sealed import seal
from thermostand.stand.chamber.compressor import CompressorState, decide, load_state, save_state
from thermostand.stand.config.stand_config import CompressorConfig

LIMITS = CompressorConfig(
    min_off_s=300, min_on_s=180, max_starts_per_h=6, start_above_cool_percent=20, stop_above_heat_percent=60
)


def test_it_rests_for_the_minimum_off_time_after_a_restart_of_the_daemon():
    state = CompressorState(running=False, since_ns=0)
    assert not decide(state, LIMITS, 0.0, 100.0, to_ns(299)).running
    assert decide(state, LIMITS, 0.0, 100.0, to_ns(300)).running


def test_it_runs_on_while_the_heater_trims_and_stops_when_it_works_hard_against_it():
    state = CompressorState(running=True, since_ns=0)
    assert decide(state, LIMITS, 40.0, 0.0, to_ns(1000)).running
    assert decide(state, LIMITS, 90.0, 0.0, to_ns(179)).running
    assert not decide(state, LIMITS, 90.0, 0.0, to_ns(180)).running


@pytest.mark.parametrize(("mv_heat", "mv_cool"), [(math.nan, math.nan), (math.nan, 80.0), (0.0, math.nan)])
def test_an_unknown_output_never_starts_it(mv_heat: float, mv_cool: float):
    state = CompressorState(running=False, since_ns=0)
    assert not decide(state, LIMITS, mv_heat, mv_cool, to_ns(10_000)).running


@given(st.lists(st.tuples(st.floats(0, 100), st.floats(0, 100)), max_size=400))
def test_whatever_the_regulator_wants_the_compressor_is_spared(outputs: list[tuple[float, float]]):
    state = CompressorState(running=False, since_ns=0)
    switched_ns = [0]
    starts_ns: list[int] = []
    for tick, (mv_heat, mv_cool) in enumerate(outputs):
        now_ns = to_ns(10.0 * (tick + 1))
        after = decide(state, LIMITS, mv_heat, mv_cool, now_ns)
        if after.running != state.running:
            rest_s = LIMITS.min_off_s if after.running else LIMITS.min_on_s
            assert now_ns - switched_ns[-1] >= to_ns(rest_s)
            switched_ns.append(now_ns)
            if after.running:
                starts_ns.append(now_ns)
                assert sum(start > now_ns - to_ns(3600) for start in starts_ns) <= LIMITS.max_starts_per_h
        state = after


NOW_NS = to_ns(1_800_000_000)
BOOT = Boot("one", NOW_NS - to_ns(100_000))
BOOTS = pytest.mark.parametrize("boot", [None, BOOT], ids=["virtual", "real"])
STARTS_NS = (NOW_NS - to_ns(2000), NOW_NS - to_ns(700))


@BOOTS
def test_what_is_kept_is_restored(tmp_path: Path, boot: Boot | None):
    path = tmp_path / "sessions" / "compressor.json"
    state = CompressorState(False, NOW_NS - to_ns(400), STARTS_NS)
    save_state(path, CompressorState(True, NOW_NS - to_ns(700), STARTS_NS), boot)
    save_state(path, state, boot)
    assert load_state(path, NOW_NS, boot) == state
    assert os.listdir(path.parent) == ["compressor.json"]


@BOOTS
def test_one_that_was_running_was_switched_off_just_now_for_all_that_is_known(tmp_path: Path, boot: Boot | None):
    save_state(tmp_path / "file", CompressorState(True, NOW_NS - to_ns(700), STARTS_NS), boot)
    assert load_state(tmp_path / "file", NOW_NS, boot) == CompressorState(False, NOW_NS, STARTS_NS)


@BOOTS
def test_the_future_is_ignored(tmp_path: Path, boot: Boot | None):
    save_state(tmp_path / "file", CompressorState(False, NOW_NS + 1, (*STARTS_NS, NOW_NS + 1)), boot)
    assert load_state(tmp_path / "file", NOW_NS, boot) == CompressorState(False, NOW_NS, STARTS_NS)


@pytest.mark.parametrize("step_s", [3600, -3600, 1e9])
def test_a_step_of_the_system_clock_between_two_daemons_changes_neither_rest_nor_starts(tmp_path: Path, step_s: float):
    """It stepped +1 h, and the compressor started again after 23 s."""
    save_state(tmp_path / "file", CompressorState(False, NOW_NS, STARTS_NS), BOOT)
    step_ns = to_ns(step_s)
    later_ns, after = NOW_NS + to_ns(23) + step_ns, Boot(BOOT.id, BOOT.began_ns + step_ns)
    found = load_state(tmp_path / "file", later_ns, after)
    assert later_ns - found.since_ns == to_ns(23)
    assert [later_ns - start_ns for start_ns in found.starts_ns] == [to_ns(2023), to_ns(723)]
    assert not decide(found, LIMITS, 0.0, 100.0, later_ns + to_ns(276.9)).running
    assert decide(found, LIMITS, 0.0, 100.0, later_ns + to_ns(277)).running


@pytest.mark.parametrize(
    ("kept_by", "read_by"),
    [
        (BOOT, Boot("two", BOOT.began_ns)),
        (BOOT, Boot("", BOOT.began_ns)),
        (Boot("", BOOT.began_ns), Boot("", BOOT.began_ns)),
        (None, BOOT),
        (BOOT, None),
    ],
    ids=["another boot", "a boot without a name", "neither has a name", "of virtual time", "virtual time"],
)
def test_a_file_of_another_boot_means_switched_off_just_now(tmp_path: Path, kept_by: Boot | None, read_by: Boot | None):
    save_state(tmp_path / "file", CompressorState(False, NOW_NS - to_ns(7200), STARTS_NS), kept_by)
    assert load_state(tmp_path / "file", NOW_NS, read_by) == CompressorState(False, NOW_NS)


def test_writers_at_once_do_not_meet_and_the_latest_call_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The disk hangs under the first; the second is done before it."""
    path, hangs, goes_on, sync = tmp_path / "file", threading.Event(), threading.Event(), os.fsync

    def hanging(fd: int) -> None:
        if threading.current_thread() is not threading.main_thread():
            hangs.set()
            assert goes_on.wait(60)
        sync(fd)

    monkeypatch.setattr("thermostand.stand.chamber.compressor.os.fsync", hanging)
    first = threading.Thread(target=save_state, args=(path, CompressorState(True, NOW_NS - 2), BOOT))
    first.start()
    assert hangs.wait(60)
    save_state(path, CompressorState(False, NOW_NS - 1), BOOT)
    goes_on.set()
    first.join()
    assert load_state(path, NOW_NS, BOOT) == CompressorState(False, NOW_NS - 1)
    assert os.listdir(tmp_path) == ["file"]


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
        seal("compressor", '{"running": false, "since_ns": 1, "starts_ns": [], "boot_id": 5}'),
        b'{"running": false, "since_ns": 1, "starts_ns": []}',
        b"\xff",
    ],
)
@BOOTS
def test_a_missing_or_damaged_file_means_switched_off_just_now(
    tmp_path: Path, content: bytes | None, boot: Boot | None
):
    path = tmp_path / "compressor.json"
    if content is not None:
        path.write_bytes(content)
    assert load_state(path, NOW_NS, boot) == CompressorState(False, NOW_NS)


def test_without_a_file_nothing_is_kept():
    save_state(None, CompressorState(False, 5), BOOT)
    assert load_state(None, NOW_NS, BOOT) == CompressorState(False, NOW_NS)


def test_a_folder_that_cannot_be_written_is_reported(tmp_path: Path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OSError, match="file"):
        save_state(tmp_path / "file" / "compressor.json", CompressorState(False, 5), BOOT)
