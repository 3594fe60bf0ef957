"""Says when the end of a run moves: an event each time it is later by another tenth of the whole."""

from __future__ import annotations

from collections.abc import Callable

from thermostand.foundation.clock import NS_PER_S, Now
from thermostand.foundation.events import ETA_SLIPPED, PLAN_CHANGED
from thermostand.foundation.hub import Hub
from thermostand.foundation.instants import local_text
from thermostand.foundation.items import Event, Item, StepMark
from thermostand.stand.gate import HELD, RELEASED

_SHARE = 0.1
_LEAST_S = 300.0  # a minute's slip of a short run is not reported


class EtaSlip:
    """A subscriber behind the one that follows the run. left_s: real seconds to the end, from an instant in ns on."""

    def __init__(self, hub: Hub, clock: Now, left_s: Callable[[int], float], utc_offset_ns: Callable[[], int]) -> None:
        self._hub, self._clock, self._left_s, self._utc_offset_ns = hub, clock, left_s, utc_offset_ns
        now_ns = clock.now_ns()
        self._step_s = max(_SHARE * left_s(now_ns), _LEAST_S)
        self._end_s = now_ns / NS_PER_S + left_s(now_ns)  # as it was reported last

    def __call__(self, item: Item) -> None:
        """Look at the end when a step begins or ends, or something holds the run or lets it go."""
        is_event = isinstance(item, Event) and item.kind in (HELD, RELEASED, PLAN_CHANGED)
        if not is_event and not isinstance(item, StepMark):
            return
        now_ns = self._clock.now_ns()
        end_s = now_ns / NS_PER_S + self._left_s(now_ns)
        later_s = end_s - self._end_s
        if later_s < self._step_s:
            return
        self._end_s = end_s
        end_ns = round(end_s * NS_PER_S)
        at = local_text(end_ns + self._utc_offset_ns())
        self._hub.publish(ETA_SLIPPED.at(now_ns, at, later_s=round(later_s, 1), end_ns=end_ns))
