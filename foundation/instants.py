"""Instants and durations as people read and write them, in the host's own zone; what is recorded or exported is UTC."""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import UTC, datetime, timedelta

from thermostand.foundation.errors import ConfigError

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_NS_PER_US = 1000
_NS_PER_S = 1_000_000_000  # as in the clock, which takes asyncio to import
_LAST_NS = (datetime.max.replace(tzinfo=UTC) - _EPOCH) // timedelta(microseconds=1) * _NS_PER_US
_OFFSET = re.compile(r"\+(?:(\d+)h)?(?:(\d+)m)?(?:(\d+(?:\.\d+)?)s?)?")


def format_date_time(time_ns: int) -> str:
    """`2026-01-01 19:00:04`, local time to the second below; for columns whose head says so."""
    return f"{_to_local(time_ns):%Y-%m-%d %H:%M:%S}"


def format_local(time_ns: int) -> str:
    """`2026-01-01 19:00:04 CET`: local time with its zone."""
    return f"{_to_local(time_ns):%Y-%m-%d %H:%M:%S %Z}"


def format_utc(time_ns: int) -> str:
    """ISO 8601 to the ns, which datetime does not have: `2026-01-01T18:00:00.123456789Z`."""
    return f"{_to_datetime(time_ns):%Y-%m-%dT%H:%M:%S}.{time_ns % _NS_PER_S:09d}Z"


def _to_datetime(time_ns: int) -> datetime:
    return _EPOCH + timedelta(microseconds=time_ns // _NS_PER_US)


def _to_local(time_ns: int) -> datetime:
    """Convert to the host's zone; UTC where that zone has no such instant."""
    instant = _to_datetime(time_ns)
    try:
        return instant.astimezone()
    except (OverflowError, ValueError, OSError):
        return instant


def format_duration(length_ns: int) -> str:
    """`16:12:33`, with the days before it when there are any; below a minute in seconds, `4.2 s`."""
    if length_ns < 60 * _NS_PER_S:
        return f"{length_ns / _NS_PER_S:.1f} s"
    return str(timedelta(seconds=round(length_ns / _NS_PER_S)))


def parse_instant(text: str, begin_ns: int, stand_ns: Callable[[int], int] = int) -> int:
    """ns since the epoch on the stand's clock, from an ISO time (local when it names no zone), which `stand_ns`
    converts, or from `+90`, `+1h30m`, `+2m5.5s` after `begin_ns`; ConfigError when it is neither, or no year has it
    that an instant can be written in."""
    time_ns = _parse(text, begin_ns, stand_ns)
    if not 0 <= time_ns <= _LAST_NS:
        raise ConfigError(f"{text}: is not between the years 1970 and 9999")
    return time_ns


def _parse(text: str, begin_ns: int, stand_ns: Callable[[int], int]) -> int:
    offset = _OFFSET.fullmatch(text)
    if offset is not None and any(offset.groups()):
        hours, minutes, seconds = (float(group or 0) for group in offset.groups())
        return begin_ns + round(min((3600 * hours + 60 * minutes + seconds) * _NS_PER_S, _LAST_NS + 1))
    try:
        instant = datetime.fromisoformat(text)
    except ValueError as error:
        raise ConfigError(f"{text}: expected a time such as 2026-01-01T18:30:00, +1h30m or step:12") from error
    try:
        instant = instant.astimezone(UTC)  # one without a zone is local
    except (OverflowError, ValueError, OSError):
        return _LAST_NS + 1
    return stand_ns((instant - _EPOCH) // timedelta(microseconds=1) * _NS_PER_US)
