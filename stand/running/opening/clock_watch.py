"""Reports, in real time, when the host's system clock departs from the stand's, and when the host was suspended."""

from __future__ import annotations

from thermostand.foundation.clock import NS_PER_S, PIECE_S, WallClock, to_ns
from thermostand.foundation.events import HOST_SUSPENDED
from thermostand.foundation.hub import Hub
from thermostand.foundation.instants import format_duration
from thermostand.recording.format.utc_offsets import REPEATED_NS, make_offset_event, make_step_event

_PERIOD_S = PIECE_S
_LIMIT_NS = to_ns(1.0)  # time servers correct by less; round number, nothing was measured


class ClockWatch:
    """Looks every second. An offset to UTC that is more than 1 s from the one recorded last is an event `clock_step`,
    whether the system clock was stepped or has drifted so far; more than 1 s of suspend is one `host_suspended`.

    `recorded_ns`: the offset last recorded in the session, when a run is resumed.
    """

    def __init__(self, hub: Hub, clock: WallClock, recorded_ns: int = 0) -> None:
        self._hub = hub
        self._clock = clock
        self._recorded_ns = recorded_ns
        self._reported_ns = 0  # when the offset was recorded last
        self._seen_ns = clock.now_ns()
        self._suspended_ns = clock.suspended_ns()

    async def run(self) -> None:
        """Look until cancelled."""
        while True:
            self.look()
            await self._clock.sleep_until(self._clock.now_ns() + to_ns(_PERIOD_S))

    def look(self) -> None:
        """Compare the clocks once, now."""
        now_ns, offset_ns, suspended_ns = (
            self._clock.now_ns(),
            self._clock.utc_offset_ns(),
            self._clock.suspended_ns(),
        )
        if suspended_ns - self._suspended_ns > _LIMIT_NS:
            self._report_suspend(now_ns, suspended_ns - self._suspended_ns)
            self._suspended_ns = suspended_ns
        if abs(offset_ns - self._recorded_ns) > _LIMIT_NS:
            self._report_step(now_ns, offset_ns)
        elif self._recorded_ns and now_ns - self._reported_ns >= REPEATED_NS:
            self._reported_ns = now_ns
            self._hub.publish(make_offset_event(now_ns, self._recorded_ns))
        self._seen_ns = now_ns

    def _report_suspend(self, now_ns: int, length_ns: int) -> None:
        data = {"length_s": length_ns / NS_PER_S, "seen_ns": self._seen_ns, "stand_ns": now_ns}
        self._hub.publish(HOST_SUSPENDED.at(now_ns, format_duration(length_ns), **data))

    def _report_step(self, now_ns: int, offset_ns: int) -> None:
        stepped = make_step_event(now_ns, self._recorded_ns, offset_ns, self._seen_ns)
        self._recorded_ns, self._reported_ns = offset_ns, now_ns
        self._hub.publish(stepped)
