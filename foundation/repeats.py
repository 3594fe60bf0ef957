"""How often a message that repeats is published: what somebody reads at night must not be buried under one sentence."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.events import always_published
from thermostand.foundation.items import Event

FIRST, PERIOD_NS = 3, 1200 * NS_PER_S
"""The first three at once, then one each 20 minutes that counts those between: at most six in any hour."""
_MOST_KEPT = 1000  # sentences: one that has been quiet for an hour is forgotten, and with this many the oldest is
_NUMBERS = re.compile(r"[-+]?[0-9][0-9.,:]*")


@dataclass(slots=True)
class _Repeated:
    """Of one sentence: how many were published since it was last quiet for an hour, when the last, how many since."""

    published: int
    published_ns: int
    seen_ns: int
    withheld: int = 0


class RepeatLimit:
    """Warnings and errors with the same kind and sentence, whatever its numbers, but for what is always published."""

    def __init__(self) -> None:
        self._repeated: dict[tuple[str, str], _Repeated] = {}

    def admit(self, event: Event) -> Event | None:
        """The event, with the number of those withheld before it in its data (`repeated`) and its text; None when it is
        withheld."""
        if event.level == "info" or always_published(event):
            return event
        now_ns, key = event.time_ns, (event.kind, _NUMBERS.sub("#", event.text))
        found = self._repeated.pop(key, None)
        if found is None or now_ns - found.seen_ns >= 3 * PERIOD_NS:
            self._repeated[key] = _Repeated(1, now_ns, now_ns)
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
        if not withheld:
            return event
        text = f"{event.text} (and {withheld} times more since the last such message)"
        return replace(event, text=text, data={**event.data, "repeated": withheld})
