"""How often what repeats is published: what an operator reads must not be buried under one sentence.

Three limits, by what the event's row says. A sentence: three at once, then one each 20 min. A state that begins and
ends, such as a device that is lost and is back: the third time within an hour its end is withheld until it has lasted
for 20 min, so that the state is reported once, not each time it begins. What begins or ends something that is counted
or waited for (`counts`) is always published, but beyond six an hour it is an information.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.events import KINDS, EventKind, get_state_change, is_urgent
from thermostand.foundation.items import Event

# Round numbers; nothing was measured.
FIRST, PERIOD_NS = 3, 1200 * NS_PER_S
"""The first three at once, then one each 20 minutes that counts those between: at most six in any hour."""
_MOST_KEPT = 1000  # sentences: one that has been quiet for an hour is forgotten, and with this many the oldest is
_NUMBERS = re.compile(r"[-+]?[0-9][0-9.,:]*")


@dataclass(slots=True)
class _RepeatCount:
    """The repeats of one sentence: how many were published since it was last quiet for an hour, when the last, how many
    since."""

    published: int
    published_ns: int
    seen_ns: int
    withheld: int = 0


@dataclass(slots=True)
class _StateRepeats:
    """The repeats of a state, say of one device: when it began in the last hour, as was published; its end, which is
    withheld; how often it has begun again since."""

    begun_ns: deque[int] = field(default_factory=deque[int])
    end: Event | None = None
    again: int = 0


class RepeatLimit:
    """Which events are published, and which of them as an information only."""

    def __init__(self) -> None:
        self._repeated: dict[tuple[str, str], _RepeatCount] = {}
        self._states: dict[tuple[str, str], _StateRepeats] = {}

    def admit(self, event: Event) -> Event | None:
        """The event, with the number of those withheld before it in its data (`repeated`) and its text; None when it is
        withheld."""
        row = KINDS.get(event.kind)
        if row is not None and (state := get_state_change(event)) is not None:
            return self._admit_state(event, row, self._states.setdefault(state, _StateRepeats()))
        is_limited = event.level != "info" or (row is not None and row.is_limited)
        if not is_limited or is_urgent(event):
            return event
        admitted = self._admit_sentence(event)
        if row is not None and row.counts:
            return admitted or replace(event, level="info")
        return admitted

    def pop_due(self, now_ns: int) -> Iterator[Event]:
        """The ends of states that were withheld, and have lasted."""
        for state in self._states.values():
            if state.end is not None and now_ns - state.end.time_ns >= PERIOD_NS:
                end, again, state.end, state.again = state.end, state.again, None, 0
                yield replace(_add_count(end, again), time_ns=now_ns)

    def _admit_state(self, event: Event, row: EventKind, state: _StateRepeats) -> Event | None:
        while state.begun_ns and event.time_ns - state.begun_ns[0] >= 3 * PERIOD_NS:
            state.begun_ns.popleft()
        if row.ends:
            if len(state.begun_ns) >= FIRST:
                state.end = event
                return None
            again, state.end, state.again = state.again, None, 0
            return _add_count(event, again)
        if state.end is not None:  # for those who were notified it goes on
            state.end = None
            state.again += 1
            return None
        state.begun_ns.append(event.time_ns)
        return event

    def _admit_sentence(self, event: Event) -> Event | None:
        now_ns, key = event.time_ns, (event.kind, _NUMBERS.sub("#", event.text))
        found = self._repeated.pop(key, None)
        if found is None or now_ns - found.seen_ns >= 3 * PERIOD_NS:
            self._repeated[key] = _RepeatCount(1, now_ns, now_ns)
            if len(self._repeated) > _MOST_KEPT:
                del self._repeated[next(iter(self._repeated))]
            return event
        self._repeated[key] = found  # the latest is the last
        found.seen_ns = now_ns
        if found.published >= FIRST and now_ns - found.published_ns < PERIOD_NS:
            found.withheld += 1
            return None
        withheld, found.withheld = found.withheld, 0
        found.published += 1
        found.published_ns = now_ns
        return _add_count(event, withheld)


def _add_count(event: Event, withheld: int) -> Event:
    if not withheld:
        return event
    text = f"{event.text} (and {withheld} times more since the last such message)"
    return replace(event, text=text, data={**event.data, "repeated": withheld})
