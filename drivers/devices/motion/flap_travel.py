"""Whether a flap that was commanded to move does: arrived, jammed or too slow, judged from what was read on the way."""

from __future__ import annotations

from thermostand.foundation.clock import seconds_ns

POLL_S = 0.05
CONFIRMATIONS = 3
JAM_S = 0.5
JAM_COUNTS = 8
# Of the time between two looks no more than this counts: while nobody looks, because the event loop or the host was
# held up, nothing is known of the flap. So a jam takes five looks at the least.
_LONGEST_LOOK_S = 2 * POLL_S


class Travel:
    """One movement from `position` to `target` (scaled feedback, counts), begun at `time_ns`, with the target sent."""

    def __init__(self, target: int, tolerance: int, travel_s: float, position: int, time_ns: int) -> None:
        self._target = target
        self._tolerance = tolerance
        self._travel_s = travel_s
        self._seen_ns = time_ns
        self._watched_ns = 0
        self._still_ns = 0
        self._still_position = position
        self._confirmed = 0

    @property
    def arrived(self) -> bool:
        """It was at its target in three looks in a row."""
        return self._confirmed >= CONFIRMATIONS

    def look(self, position: int, saturated: bool, time_ns: int) -> str:
        """What is wrong, "" when nothing is; `time_ns` is when the position was read, `saturated` whether the motor
        gave (nearly) all it may."""
        step_ns = min(max(0, time_ns - self._seen_ns), seconds_ns(_LONGEST_LOOK_S))
        self._seen_ns = time_ns
        self._watched_ns += step_ns
        self._still_ns += step_ns
        if abs(position - self._still_position) >= JAM_COUNTS:
            self._still_ns, self._still_position = 0, position
        self._confirmed = self._confirmed + 1 if abs(position - self._target) <= self._tolerance else 0
        if saturated and self._still_ns >= seconds_ns(JAM_S):
            return f"jammed at {position} on the way to {self._target}"
        if not self._confirmed and self._watched_ns > seconds_ns(self._travel_s):
            return f"at {position}, not at {self._target}, after {self._travel_s:g} s"
        return ""
