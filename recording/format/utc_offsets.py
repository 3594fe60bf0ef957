"""From instants of the stand's clock, which never steps, to UTC as the host's system clock had it, and back.

A recording has instants of the stand's clock only. When the system clock was stepped against it, or has drifted away,
an event of kind `clock_step` says so:

    offset_before_ns   UTC minus the stand's clock as it was recorded last, 0 at the start of a session
    offset_after_ns    the same from now on
    seen_ns            the last instant at which the former still held; the step is between it and stand_ns
    stand_ns, utc_ns   now, on both clocks

As long as the offset is not 0 the event is repeated every REPEATED_NS, so that a segment can be understood without the
ones before it. What shows or exports an instant as UTC adds the offset that held then; durations are differences of
instants of the stand's clock.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.events import CLOCK_STEP
from thermostand.foundation.instants import format_date_time, format_local, format_utc
from thermostand.foundation.items import Event

REPEATED_NS = 300 * NS_PER_S  # as long as the offset is not 0
_INT64 = (-(1 << 63), (1 << 63) - 1)


@dataclass(frozen=True, slots=True)
class UtcOffsets:
    """UTC minus the stand's clock: `offsets_ns[k]` from `times_ns[k]` on, `first_ns` before all of them."""

    first_ns: int = 0
    times_ns: tuple[int, ...] = ()
    offsets_ns: tuple[int, ...] = ()

    def at(self, stand_ns: int) -> int:
        """The offset that held at an instant of the stand's clock."""
        index = bisect_right(self.times_ns, stand_ns)
        return self.offsets_ns[index - 1] if index else self.first_ns

    def utc_ns(self, stand_ns: int) -> int:
        """Return that instant as UTC."""
        return min(max(stand_ns + self.at(stand_ns), _INT64[0]), _INT64[1])

    def stand_ns(self, utc_ns: int) -> int:
        """The first instant of the stand's clock at which UTC was `utc_ns`, or later when it was stepped over."""
        offset_ns, begin_ns = self.first_ns, _INT64[0]
        for end_ns, next_ns in zip(self.times_ns, self.offsets_ns, strict=True):
            if (found_ns := max(utc_ns - offset_ns, begin_ns)) < end_ns:
                return found_ns
            offset_ns, begin_ns = next_ns, end_ns
        return max(utc_ns - offset_ns, begin_ns)

    def date_time(self, stand_ns: int) -> str:
        """`2026-01-01 19:00:04`, local time to the second below."""
        return format_date_time(self.utc_ns(stand_ns))

    def local_text(self, stand_ns: int) -> str:
        """The same with its zone: `2026-01-01 19:00:04 CET`."""
        return format_local(self.utc_ns(stand_ns))

    def utc_text(self, stand_ns: int) -> str:
        """UTC in ISO 8601 to the ns."""
        return format_utc(self.utc_ns(stand_ns))


def collect_offsets(events: Iterable[Event]) -> UtcOffsets:
    """Return what the events of a session say; one whose data cannot be understood says nothing."""
    steps = sorted(step for event in events if event.kind == CLOCK_STEP and (step := _parse_step(event)) is not None)
    if not steps:
        return UtcOffsets()
    return UtcOffsets(steps[0][1], tuple(step[0] for step in steps), tuple(step[2] for step in steps))


def make_offset_event(time_ns: int, offset_ns: int) -> Event:
    """Make the event that the offset is this one still, for a segment or a part that begins with it."""
    return make_step_event(time_ns, offset_ns, offset_ns, time_ns)


def make_step_event(time_ns: int, before_ns: int, after_ns: int, seen_ns: int) -> Event:
    """Make the event that the offset is `after_ns` now, and was before_ns until seen_ns."""
    return CLOCK_STEP.at(
        time_ns,
        offset_before_ns=before_ns,
        offset_after_ns=after_ns,
        seen_ns=seen_ns,
        stand_ns=time_ns,
        utc_ns=time_ns + after_ns,
    )


def _parse_step(event: Event) -> tuple[int, int, int] | None:
    """Return from when on, and the offset before and after, ns."""
    before, after = event.data.get("offset_before_ns"), event.data.get("offset_after_ns")
    if isinstance(before, int) and isinstance(after, int):
        return event.time_ns, before, after
    return None
