"""Follows a stand from a daemon's HTTP interface."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import cast

from thermostand.foundation.errors import SessionError
from thermostand.foundation.instants import local_text
from thermostand.stand.serving.client import API, Server
from thermostand.stand.serving.desk import StandState
from thermostand.stand.watching.moment import Moment, moment_of
from thermostand.stand.watching.remedies import next_command

_EVENTS = 500

EventData = Mapping[str, object]


class There:
    """Looks at a stand: what has happened since the last look, and how it stands. SessionError when it does not
    answer."""

    def __init__(self, server: Server) -> None:
        self.server = server
        self.session = ""  # the folder of the run that is or was under way
        state = server.state()
        self._seq = state.seq
        self._know(state)

    def events(self) -> list[EventData]:
        """Since the last look, as the interface gives them."""
        found = self.server.request("GET", f"{API}/events?from={self._seq}&limit={_EVENTS}")
        answer = cast("EventData", found)
        self._seq = max(self._seq, cast("int", answer.get("seq", 0)))
        return cast("list[EventData]", answer.get("events", []))

    def moment(self, state: StandState) -> Moment:
        """What is shown of a state."""
        self._know(state)
        return moment_of(state, None if state.run is None else self._drift_px())

    def line(self, event: EventData) -> str:
        """An event as it is shown, with what to type."""
        return event_line(event, self.session)

    def _know(self, state: StandState) -> None:
        self.session = state.run.session if state.run is not None else self.session

    def _drift_px(self) -> float | None:
        """Of the last frame that the daemon looked at; None for a run of its own, which looks at none."""
        with suppress(SessionError):
            found = self.server.request("GET", f"{API}/frame")
            drift_px = cast("EventData", found).get("mean_px") if isinstance(found, dict) else None
            return drift_px if isinstance(drift_px, float) else None
        return None


def event_line(event: EventData, session: str = "") -> str:
    """`2026-01-01 19:00:04 CET  warning: what has happened; what to type`."""
    time_ns, offset_ns = cast("int", event["time_ns"]), cast("int", event["utc_offset_ns"])
    said = f"{local_text(time_ns + offset_ns)}  "
    if event["level"] == "info":
        return f"{said}{event['text']}"
    data = cast("EventData", event.get("data") or {})
    return f"{said}{event['level']}: {event['text']}; {next_command(str(event['kind']), data, session)}"
