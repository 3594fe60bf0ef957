"""What the telemetry of a session says, gathered message by message, for those who look at all of it."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from thermostand.foundation.items import Event, StepMark
from thermostand.recording.format import messages
from thermostand.recording.format.records import Message


@dataclass(frozen=True, slots=True)
class Channel:
    """The readings of one channel in the order they came."""

    unit: str
    times_ns: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))

    @property
    def is_degC(self) -> bool:
        """It is a temperature."""
        return self.unit == "degC"

    def sorted_times_ns(self) -> NDArray[np.int64]:
        """The instants, ascending, shape (n,)."""
        return np.sort(np.array(self.times_ns, np.int64))


@dataclass
class Contents:
    """Everything but the images; `channels` by their names."""

    events: list[Event] = field(default_factory=list[Event])
    marks: list[StepMark] = field(default_factory=list[StepMark])
    channels: dict[str, Channel] = field(default_factory=dict[str, Channel])

    def receive(self, message: Message) -> None:
        """Keep what a message of the telemetry says; SessionError when it cannot be read."""
        match message.topic:
            case messages.EVENT:
                self.events.append(messages.decode_event(message.data, message.time_ns))
            case messages.STEP:
                self.marks.append(messages.decode_step(message.data, message.time_ns))
            case topic if topic in messages.KIND_OF_TOPIC:
                for reading in messages.decode_batch(topic, message.data, message.time_ns).readings:
                    channel = self.channels.setdefault(reading.channel, Channel(reading.unit))
                    channel.times_ns.append(reading.time_ns)
                    channel.values.append(reading.value)
            case _:
                pass  # what viewers read: the same things in another form
