"""Which events of a stand become messages: each cause once, when it has lasted, and once more when it is over."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from foundation.clock import seconds_ns
from foundation.items import Event
from stand.config.alerts_section import Cause

# raised: sent at once. lasting: sent when it is not over within the grace time. over: the end of one.
Phase = Literal["raised", "lasting", "over"]
RUN_FAILED = "run_failed"  # of one that may not have begun; published to alerts only
_HOUR_NS = seconds_ns(3600)
_TITLES: dict[Cause, str] = {
    "trip": "TRIPPED",
    "hold": "held",
    "device_lost": "a device is lost",
    "disk": "the disk",
    "prompt": "somebody is needed",
    "run_started": "a run has begun",
    "run_finished": "a run is complete",
    "run_aborted": "a run has ended before its plan was done",
    "queue_empty": "the queue is empty",
    "eta_slipped": "a run takes longer",
}
_BAD: frozenset[Cause] = frozenset({"trip", "hold", "device_lost", "disk"})


class Sign(NamedTuple):
    """What an event means: of which cause, which one of it, and whether it begins or is over."""

    cause: Cause
    key: str
    phase: Phase


class Message(NamedTuple):
    """What is sent."""

    cause: Cause
    title: str
    text: str


_OF_KIND: dict[str, Sign] = {
    "hold_stays": Sign("hold", "guard", "raised"),
    "hold_ended": Sign("hold", "guard", "over"),
    "not_confirmed_safe": Sign("trip", "unsafe", "raised"),
    "confirmed_safe": Sign("trip", "unsafe", "over"),
    "flap_not_shut": Sign("hold", "flap", "raised"),
    "camera_lost": Sign("device_lost", "camera", "lasting"),
    "camera_back": Sign("device_lost", "camera", "over"),
    "disk_nearly_full": Sign("disk", "nearly full", "raised"),
    "frames_stopped": Sign("disk", "frames", "lasting"),
    "frames_resumed": Sign("disk", "frames", "over"),
    "telemetry_not_saved": Sign("disk", "telemetry", "lasting"),
    "telemetry_saved_again": Sign("disk", "telemetry", "over"),
    "readings_dropped": Sign("disk", "readings", "raised"),
    "readings_lost": Sign("disk", "readings", "over"),
    "run.start": Sign("run_started", "", "raised"),
    "run.resume": Sign("run_started", "", "raised"),
    RUN_FAILED: Sign("run_aborted", "", "raised"),
    "queue_empty": Sign("queue_empty", "", "raised"),
    "eta_slipped": Sign("eta_slipped", "", "raised"),
}


def sign_of(event: Event) -> Sign | None:
    """What the event means for people elsewhere; None for most."""
    if event.kind.startswith("guard."):
        action = event.data.get("action")
        if action not in ("abort", "hold"):
            return None
        return Sign("trip" if action == "abort" else "hold", "guard", "raised" if action == "abort" else "lasting")
    match event.kind:
        case "device_lost" | "device_back":
            phase: Phase = "lasting" if event.kind == "device_lost" else "over"
            return Sign("device_lost", str(event.data.get("device", "")), phase)
        case "released" if event.data.get("reason") == "interlock":
            return Sign("hold", "guard", "over")
        case "prompt":
            return Sign("prompt", event.text, "raised") if event.level == "warning" else None
        case "run.end":
            return Sign("run_finished" if event.data.get("status") == "complete" else "run_aborted", "", "raised")
        case kind:
            return _OF_KIND.get(kind)


@dataclass
class AlertBook:
    """Which messages are due. Of one cause and key there is one message until it is over; a run's begin or end, and
    what has no end, are sent each time. With more than most_per_h in an hour only trips are sent, and how many were
    left out."""

    name: str
    causes: Collection[Cause]
    grace_ns: int
    most_per_h: int
    _open: dict[tuple[Cause, str], tuple[Event, bool]] = field(
        default_factory=dict[tuple[Cause, str], tuple[Event, bool]]
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
        sign = sign_of(event)
        if sign is None:
            return []
        if sign.phase == "over":
            before = self._open.pop((sign.cause, sign.key), None)
            text = f"{event.text} (it was: {before[0].text})" if before else ""
            return self._limited([(sign.cause, "ok again", text)] if before and before[1] else [], now_ns)
        if event.kind in ("run.start", "run.resume", "run.end"):
            self._open = {}
            self._run_ended = event.kind == "run.end"
        elif event.kind == RUN_FAILED and self._run_ended:
            return []
        if sign.cause not in _BAD:
            return self._limited([(sign.cause, _TITLES[sign.cause], event.text)], now_ns)
        known = self._open.get((sign.cause, sign.key))
        if known is not None and (known[1] or sign.phase == "lasting"):
            return []
        is_due = sign.phase == "raised"
        self._open[sign.cause, sign.key] = (event, is_due)
        return self._limited([(sign.cause, _TITLES[sign.cause], event.text)] if is_due else [], now_ns)

    def due(self, now_ns: int) -> list[Message]:
        """What has lasted for the grace time by now."""
        found: list[tuple[Cause, str, str]] = []
        for (cause, key), (event, was_sent) in self._open.items():
            if not was_sent and now_ns - event.time_ns >= self.grace_ns:
                self._open[cause, key] = (event, True)
                found.append((cause, _TITLES[cause], event.text))
        return self._limited(found, now_ns)

    def _limited(self, found: Iterable[tuple[Cause, str, str]], now_ns: int) -> list[Message]:
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
