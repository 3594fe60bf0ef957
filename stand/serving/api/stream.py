"""The stream of a stand: numbered messages, replayed from a ring, to viewers of which none can keep the others waiting.

    {"seq": 28312345, "type": "event", "data": {"kind": "held", "level": "warning", "text": ..., "data": {...}, ...}}

`reading` is a batch of one device, `state` the whole stand (its seq is that of the last message before it), and `gone`
says which numbers are not given any more, or were too many for this viewer.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Literal

from pydantic_core import to_json

from thermostand.foundation.items import Batch, Event, Item, Original, StepMark
from thermostand.foundation.readings import Frame, Quality, Reading
from thermostand.stand.serving.api.bridge import Bridge, StateSnapshot
from thermostand.stand.serving.api_models import StandState

EVENTS = 5_000  # kept for those who reconnect: days
READINGS = 3_000  # batches: some minutes; the page's history has the rest
_QUEUE = 512  # messages that a viewer may be behind
_BETWEEN_STATES = 32  # messages at most, for one that is behind
_BUSY_S, _IDLE_S = 0.05, 0.25  # between looks for what is new, with and without viewers
MOST_VIEWERS = 24  # below listening.MOST_CLIENTS, so that requests still find a place

Kind = Literal["state", "event", "reading", "gone"]


@dataclass(frozen=True, slots=True)
class StreamMessage:
    """A numbered item of the stream; data: JSON of an object. Written once for all viewers, and as a text: thousands
    are kept, and each value in them would be looked at whenever Python searches this process for garbage."""

    seq: int
    type: Kind
    # As text: a search for garbage took 14 ms for 8,000 kept messages of objects, and takes 0.3.
    data: str

    def json(self) -> str:
        """The item as it is sent."""
        return f'{{"seq":{self.seq},"type":"{self.type}","data":{self.data}}}'

    def numbered(self) -> str:
        """The data with the number in them."""
        return f'{{"seq":{self.seq},{self.data[1:]}'


def make_json(value: object) -> str:
    """JSON of any value, NaN and infinities as null."""
    return to_json(value, inf_nan_mode="null", fallback=_make_plain).decode()


def _make_plain(value: object) -> object:
    return dict(value) if isinstance(value, Mapping) else str(value)  # pyright: ignore[reportUnknownVariableType]


def make_message(seq: int, utc_offset_ns: int, item: Item) -> StreamMessage:
    """An item as the stream gives it: a step of the plan that began or ended is an event of kind `step`."""
    stamp = {"time_ns": item.time_ns, "utc_offset_ns": utc_offset_ns}
    match item:
        case Event(_, level, kind, text, data):
            fields = {**stamp, "level": level, "kind": kind, "text": text, "data": dict(data)}
            return StreamMessage(seq, "event", make_json(fields))
        case StepMark(_, step_id, index, kind, state, parameters):
            data = {"step_id": step_id, "index": index, "step": kind, "state": state, "parameters": parameters}
            text = f"step {index + 1} ({kind}) {state}"
            fields = {**stamp, "level": "info", "kind": "step", "text": text, "data": data}
            return StreamMessage(seq, "event", make_json(fields))
        case Batch(device, _, readings):
            values = {reading.channel: make_reading(reading) for reading in readings}
            return StreamMessage(seq, "reading", make_json({**stamp, "device": device, "readings": values}))
        case Frame() | Original():
            raise ValueError("images are no items of the stream")


def make_reading(reading: Reading) -> dict[str, object]:
    """The fields of desk.ReadingState."""
    value = None if reading.quality is Quality.BAD else reading.value
    return {
        "value": value,
        "unit": reading.unit,
        "quality": reading.quality,
        "time_ns": reading.time_ns,
        "reason": reading.reason,
        "cause": reading.cause,
    }


class Viewer:
    """One client: what it has not been sent yet, a replay to begin with. Of states only the last one counts."""

    def __init__(self, replay: Iterable[StreamMessage] = ()) -> None:
        self.drops = 0
        self._waiting = deque(replay)
        self._most = _QUEUE + len(self._waiting)
        self._lost: tuple[int, int] | None = None
        self._state = ""
        self._since_state = 0
        self._something = asyncio.Event()

    def give(self, message: StreamMessage) -> None:
        """Queue a message, instead of the oldest one when there are too many."""
        if len(self._waiting) >= self._most:
            oldest = self._waiting.popleft()
            self.drops += 1
            self._lost = (oldest.seq if self._lost is None else self._lost[0], oldest.seq)
        self._waiting.append(message)
        self._something.set()

    def tell(self, state: str) -> None:
        """The state, as it is now."""
        self._state = state
        self._something.set()

    async def next(self) -> str:
        """The next message; waits for one."""
        await asyncio.sleep(0)  # in a replay, too, others have their turn, and it is seen when the viewer leaves
        while not (self._lost or self._waiting or self._state):
            self._something.clear()
            await self._something.wait()
        if self._state and (not self._waiting or self._since_state >= _BETWEEN_STATES):
            state, self._state, self._since_state = self._state, "", 0
            return state
        self._since_state += 1
        if self._lost is not None:
            (first, last), self._lost = self._lost, None
            return StreamMessage(last, "gone", make_json({"first": first, "last": last, "drops": self.drops})).json()
        return self._waiting.popleft().json()


class Stream:
    """Takes what the control loop has published and gives it to every viewer; runs until cancelled."""

    def __init__(self, bridge: Bridge) -> None:
        self.drops = 0  # items that were dropped before this thread took them
        self._bridge = bridge
        self._events: deque[StreamMessage] = deque(maxlen=EVENTS)
        self._readings: deque[StreamMessage] = deque(maxlen=READINGS)
        self._first = self._seq = bridge.snapshot.state.seq
        self._gone_events = self._gone_readings = self._seq  # the last numbers that are in no ring any more
        self._viewers: set[Viewer] = set()
        self._reported: StateSnapshot | None = None

    @property
    def viewers(self) -> int:
        """How many there are."""
        return len(self._viewers)

    async def run(self) -> None:
        """Run until cancelled."""
        while True:
            self.pump()
            await asyncio.sleep(_BUSY_S if self._viewers else _IDLE_S)

    def pump(self) -> None:
        """Send what is new since the last time."""
        for seq, utc_offset_ns, item in self._bridge.take():
            self.drops += seq - self._seq - 1
            self._seq = seq
            message = make_message(seq, utc_offset_ns, item)
            self._keep(message)
            for viewer in self._viewers:
                viewer.give(message)
        snapshot = self._bridge.snapshot
        if snapshot is not self._reported and self._viewers:
            self._reported, text = snapshot, make_state_json(snapshot, self.drops)
            for viewer in self._viewers:
                viewer.tell(text)

    def join(self, after: int | None) -> Viewer:
        """A new viewer: with all that there is after a number, or from now on, and then the state."""
        self.pump()
        missing = None if after is None else self.missing(after)
        viewer = Viewer(() if after is None else (*((missing,) if missing else ()), *self.after(after)))
        viewer.tell(make_state_json(self._bridge.snapshot, self.drops))
        self._viewers.add(viewer)
        return viewer

    def leave(self, viewer: Viewer) -> None:
        """It is not there any more."""
        self._viewers.discard(viewer)

    def events(self, after: int, limit: int) -> list[StreamMessage]:
        """The events after a number, at most so many."""
        self.pump()
        return list(islice((each for each in self._events if each.seq > after), limit))

    def missing(self, after: int) -> StreamMessage | None:
        """Return what a viewer that has seen all up to `after` cannot be given any more."""
        first, last = after + 1, max(self._gone_events, self._gone_readings)
        if after > self._seq:  # of another stream
            first, last = self._first + 1, self._first
        elif last < first:
            return None
        gone = {"first": first, "last": last, "types": self.list_missing_types(after), "drops": self.drops}
        return StreamMessage(last, "gone", make_json(gone))

    def list_missing_types(self, after: int) -> list[Kind]:
        """List the types of which some are gone for a viewer that has seen all up to `after`."""
        is_other = after > self._seq  # of another stream
        gone: tuple[tuple[Kind, int], ...] = (("event", self._gone_events), ("reading", self._gone_readings))
        return [kind for kind, last in gone if last > after or is_other]

    def after(self, after: int) -> Iterator[StreamMessage]:
        """Return what is kept of both rings, in order; all of it for a number of another stream."""
        after = after if after <= self._seq else self._first
        kept = sorted((*self._events, *self._readings), key=lambda message: message.seq)
        return (message for message in kept if message.seq > after)

    def _keep(self, message: StreamMessage) -> None:
        if message.type == "event":
            if len(self._events) == EVENTS:
                self._gone_events = self._events[0].seq
            self._events.append(message)
        else:
            if len(self._readings) == READINGS:
                self._gone_readings = self._readings[0].seq
            self._readings.append(message)


def make_state_json(snapshot: StateSnapshot, drops: int) -> str:
    """The message of a state."""
    state: StandState = snapshot.state.model_copy(update={"drops": drops})
    return f'{{"seq":{state.seq},"type":"state","data":{state.model_dump_json()}}}'
