"""Which events of a stand become messages: each cause once, when it has lasted, and once more when it is over."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from thermostand.foundation.clock import seconds_ns
from thermostand.foundation.events import RUN_BEGINS, RUN_END, RUN_FAILED, TITLES, AlertCause, alert_of
from thermostand.foundation.items import Event

_HOUR_NS = seconds_ns(3600)
_BAD: frozenset[AlertCause] = frozenset({"trip", "hold", "device_lost", "disk"})


class Message(NamedTuple):
    """What is sent."""

    cause: AlertCause
    title: str
    text: str


@dataclass
class AlertBook:
    """Which messages are due. Of one cause and key there is one message until it is over; a run's begin or end, and
    what has no end, are sent each time. With more than most_per_h in an hour only trips are sent, and how many were
    left out."""

    name: str
    causes: Collection[AlertCause]
    grace_ns: int
    most_per_h: int
    _open: dict[tuple[AlertCause, str], tuple[Event, bool]] = field(
        default_factory=dict[tuple[AlertCause, str], tuple[Event, bool]]
    )  # the event, and whether it was sent
    _sent_ns: deque[int] = field(default_factory=deque[int])
    _left_out: int = 0
    _run_ended: bool = False

    @property
    def is_well(self) -> bool:
        """Nothing is wrong; may be asked from another thread."""
        return not any(cause in _BAD and key != "nearly full" for cause, key in tuple(self._open))

    def receive(self, event: Event, now_ns: int) -> list[Message]:
        """What is to be sent at once."""
        alert = alert_of(event)
        if alert is None:
            return []
        if alert.phase == "over":
            before = self._open.pop((alert.cause, alert.key), None)
            text = f"{event.text} (it was: {before[0].text})" if before else ""
            return self._limited([(alert.cause, "ok again", text)] if before and before[1] else [], now_ns)
        if event.kind in (*RUN_BEGINS, RUN_END):
            self._open = {}
            self._run_ended = event.kind == RUN_END
        elif event.kind == RUN_FAILED and self._run_ended:
            return []
        if alert.cause not in _BAD:
            return self._limited([(alert.cause, TITLES[alert.cause], event.text)], now_ns)
        known = self._open.get((alert.cause, alert.key))
        if known is not None and (known[1] or alert.phase == "lasting"):
            return []
        is_due = alert.phase == "raised"
        self._open[alert.cause, alert.key] = (event, is_due)
        return self._limited([(alert.cause, TITLES[alert.cause], event.text)] if is_due else [], now_ns)

    def due(self, now_ns: int) -> list[Message]:
        """What has lasted for the grace time by now."""
        found: list[tuple[AlertCause, str, str]] = []
        for (cause, key), (event, was_sent) in self._open.items():
            if not was_sent and now_ns - event.time_ns >= self.grace_ns:
                self._open[cause, key] = (event, True)
                found.append((cause, TITLES[cause], event.text))
        return self._limited(found, now_ns)

    def _limited(self, found: Iterable[tuple[AlertCause, str, str]], now_ns: int) -> list[Message]:
        """Those that are wanted, and within what an hour may have."""
        messages: list[Message] = []
        while self._sent_ns and now_ns - self._sent_ns[0] >= _HOUR_NS:
            self._sent_ns.popleft()
        for cause, title, text in found:
            if cause not in self.causes:
                continue
            if len(self._sent_ns) >= self.most_per_h and cause != "trip":
                self._left_out += 1
                continue
            more = f"\n{self._left_out} messages before this one were left out" if self._left_out else ""
            self._left_out = 0
            self._sent_ns.append(now_ns)
            messages.append(Message(cause, f"{self.name}: {title}", f"{text}{more}"))
        return messages
