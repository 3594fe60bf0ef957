"""People read and give local time; what is recorded and exported is UTC."""

import time

import pytest

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.instants import format_date_time, format_local, format_utc, parse_instant
from thermostand.recording.format.utc_offsets import UtcOffsets

WINTER_NS = 1_767_290_404 * NS_PER_S  # 2026-01-01T18:00:04Z
SUMMER_NS = 1_782_928_804 * NS_PER_S  # 2026-07-01T18:00:04Z


@pytest.fixture
def warsaw(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("TZ", "CET-1CEST,M3.5.0,M10.5.0/3")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.mark.usefixtures("warsaw")
def test_times_are_shown_in_the_zone_of_then():
    assert format_local(WINTER_NS) == "2026-01-01 19:00:04 CET"
    assert format_local(SUMMER_NS) == "2026-07-01 20:00:04 CEST"
    assert format_date_time(SUMMER_NS) == "2026-07-01 20:00:04"
    assert UtcOffsets(3600 * NS_PER_S).local_text(WINTER_NS) == "2026-01-01 20:00:04 CET"
    assert format_utc(WINTER_NS).startswith("2026-01-01T18:00:04.")


@pytest.mark.usefixtures("warsaw")
def test_a_time_without_a_zone_is_local():
    assert parse_instant("2026-01-01T19:00:04", 0) == WINTER_NS
    assert parse_instant("2026-07-01T20:00:04", 0) == SUMMER_NS
    assert parse_instant("2026-01-01T18:00:04Z", 0) == WINTER_NS


@pytest.mark.usefixtures("warsaw")
@pytest.mark.parametrize("time_ns", [-(1 << 63), 0, (1 << 63) - 1])
def test_every_instant_of_a_recording_can_be_shown(time_ns: int):
    assert len(format_local(time_ns).split()) == 3
