"""What the watchers of a stand are shown at one instant: its state as its service has it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import cast

from thermostand.foundation.errors import SessionError
from thermostand.foundation.instants import format_local
from thermostand.stand.commands.remedies import get_next_command
from thermostand.stand.safety.gate import REASON_TEXTS
from thermostand.stand.serving.api_models import StandState
from thermostand.stand.serving.client import API, Server

# Follows a stand from a daemon's HTTP interface.

_EVENTS = 500  # in one answer; the rest is asked for next

EventData = Mapping[str, object]


class RemoteStand:
    """Looks at a stand: what has happened since the last look, and how it stands. SessionError when it does not
    answer."""

    def __init__(self, server: Server) -> None:
        self.server = server
        self.session = ""  # the folder of the run that is or was under way
        state = server.state()
        self._seq = state.seq
        self._note_session(state)

    def events(self) -> list[EventData]:
        """The events since the last look, as the interface gives them."""
        found = self.server.request("GET", f"{API}/events?from={self._seq}&limit={_EVENTS}")
        answer = cast("EventData", found)
        self._seq = max(self._seq, cast("int", answer.get("seq", 0)))
        return cast("list[EventData]", answer.get("events", []))

    def take_snapshot(self, state: StandState) -> StatusSnapshot:
        """Return what is shown of a state."""
        self._note_session(state)
        return make_snapshot(state, None if state.run is None else self._fetch_drift_px())

    def line(self, event: EventData) -> str:
        """An event as it is shown, with what to type."""
        return format_event(event, self.session)

    def _note_session(self, state: StandState) -> None:
        self.session = state.run.session if state.run is not None else self.session

    def _fetch_drift_px(self) -> float | None:
        """Fetch the drift of the last frame that the daemon looked at; None for a run of its own, which looks at
        none."""
        with suppress(SessionError):
            found = self.server.request("GET", f"{API}/frame")
            drift_px = cast("EventData", found).get("mean_px") if isinstance(found, dict) else None
            return drift_px if isinstance(drift_px, float) else None
        return None


def format_event(event: EventData, session: str = "") -> str:
    """`warning: 2026-01-01 19:00:04 CET  what has happened; what to type`."""
    time_ns, offset_ns, level = cast("int", event["time_ns"]), cast("int", event["utc_offset_ns"]), event["level"]
    text = f"{format_local(time_ns + offset_ns)}  {event['text']}"
    if level == "info":
        return text
    data = cast("EventData", event.get("data") or {})
    return f"{level}: {text}; {get_next_command(str(event['kind']), data, session)}"


SET_POINT, AIR, CAMERA = "regulator.sp", "thermometers.air", "camera.temperature"


@dataclass(frozen=True, slots=True)
class StatusSnapshot:
    """now_ns, end_ns: UTC, ns since the epoch. share: how much of the run is done, 0..1, None without one. step: number
    of the step under way, 0 before the first; doing: that step in words. held: what holds the run, in words. A
    temperature that is BAD or unknown is None, as all else that is not known. end_within_s: by how much the end may
    be earlier or later. drift_px: mean drift of the markers in the last frame that was looked at.
    """

    now_ns: int
    title: str
    share: float | None = None
    step: int = 0
    steps: int = 0
    doing: str = ""
    held: str = ""
    setpoint_degC: float | None = None
    air_degC: float | None = None
    camera_degC: float | None = None
    frames: int = 0
    frames_planned: int | None = None
    frames_lost: int = 0
    drift_px: float | None = None
    disk_free_bytes: int | None = None
    end_ns: int | None = None
    end_within_s: float | None = None


def make_snapshot(state: StandState, drift_px: float | None = None) -> StatusSnapshot:
    """Make the snapshot of a stand from what its daemon reports."""
    offset_ns, run = state.utc_offset_ns, state.run
    held = describe_holds(state.reasons)
    setpoint_degC, air_degC, camera_degC = state.setpoint_degC, _get_value(state, AIR), _get_value(state, CAMERA)
    if run is None:
        waiting = sum(each.state == "waiting" for each in state.queue)
        queued = f"{waiting} queued" if waiting else ""
        doing = "; ".join(part for part in ("no run", describe_manual_heat(state), queued) if part)
        return StatusSnapshot(
            state.now_ns + offset_ns,
            state.stand,
            doing=doing,
            held=held or state.queue_halted,
            disk_free_bytes=state.disk_free_bytes,
            setpoint_degC=setpoint_degC,
            air_degC=air_degC,
            camera_degC=camera_degC,
        )
    return StatusSnapshot(
        run.now_ns + run.utc_offset_ns,
        f"{run.recipe} on {state.stand}",
        compute_share_done(state),
        run.step,
        run.steps,
        run.doing,
        "is being ended" if run.state == "stopping" else held,
        setpoint_degC,
        air_degC,
        camera_degC,
        frames=run.frames_saved,
        frames_planned=run.frames_planned,
        frames_lost=run.frames_lost,
        drift_px=drift_px,
        disk_free_bytes=run.disk_free_bytes,
        end_ns=None if run.end_ns is None else run.end_ns + run.utc_offset_ns,
        end_within_s=run.end_within_s,
    )


def describe_manual_heat(state: StandState) -> str:
    """`heated by hand to 40 °C since 2026-01-01 19:00:04 CET`; "" when nobody heats by hand."""
    if (hand := state.by_hand) is None:
        return ""
    text = f"heated by hand to {hand.setpoint_degC:g} °C since {format_local(hand.since_ns + state.utc_offset_ns)}"
    if hand.cut_ns is None:
        return text
    return f"{text}; heat cut by the relay board's timer at {format_local(hand.cut_ns + state.utc_offset_ns)}"


def list_unsafe_parts(state: StandState) -> Iterable[str]:
    """A sentence for each part that has not confirmed its safe state."""
    for part in state.not_confirmed:
        since = format_local(part.since_ns + state.utc_offset_ns)
        found = (
            f"{part.reason}; it is tried again until it confirms" if part.reason else f"{part.name} is being made safe"
        )
        yield f"since {since}: {found}"
        if part.reason and part.timer_s is not None:
            latest = f"at the latest {part.timer_s:g} s after that time"
            yield f"heat and cold: the relay board's own timer ends them, {latest}"


def _get_value(state: StandState, channel: str) -> float | None:
    return state.readings[channel].value if channel in state.readings else None


def compute_share_done(state: StandState) -> float | None:
    """Compute which share of the run under way is done, by the time it has taken and will take; None when its end, or
    its begin, is not known."""
    run = state.run
    began_ns = next((each.began_ns for each in state.queue if each.state == "running"), None)
    if run is None or run.end_ns is None or began_ns is None or run.end_ns <= began_ns:
        return None
    return min(1.0, max(0.0, (run.now_ns - began_ns) / (run.end_ns - began_ns)))


def describe_holds(reasons: Iterable[str]) -> str:
    """`held by an operator's pause`; "" when nothing holds the run."""
    causes = ", ".join(REASON_TEXTS.get(reason, reason) for reason in reasons)
    return f"held by {causes}" if causes else ""
