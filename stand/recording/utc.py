"""An instant as text."""

from __future__ import annotations

from datetime import UTC, datetime

from drivers.clock import NS_PER_S


def utc_text(time_ns: int) -> str:
    """ISO 8601 in UTC to the ns, which datetime does not have: 2026-01-01T18:00:00.123456789Z."""
    seconds, rest_ns = divmod(time_ns, NS_PER_S)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{rest_ns:09d}Z"
