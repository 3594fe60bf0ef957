"""What the telemetry of a recorded session consists of: its topics, the devices on them, and its messages."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from thermostand.foundation.errors import SessionError
from thermostand.recording.format import messages
from thermostand.recording.format.batches import READINGS, make_batch_schema
from thermostand.recording.format.records import RecordedMessage, read_telemetry_messages
from thermostand.recording.reading.recorded_devices import recorded_channels, recorded_devices
from thermostand.recording.reading.session import Session
from thermostand.recording.writing.segment import Topic
from thermostand.recording.writing.session_spec import make_readings_topic


def list_topics(session: Session) -> tuple[Topic, ...]:
    """The topics of all telemetry segments in the order they were declared; SessionError when one is unknown."""
    topics = {f"{READINGS}{name}": each for name, each in _list_readings_topics(session).items()}
    for channel in recorded_channels(session.telemetry_segments):
        if channel.topic in topics:
            continue
        if channel.topic not in messages.CLASSES:
            raise SessionError(f"{session.path}: was recorded by another version; its topic {channel.topic} is unknown")
        topics[channel.topic] = Topic(channel.topic, messages.CLASSES[channel.topic])
    return tuple(topics.values())


def _list_readings_topics(session: Session) -> dict[str, Topic]:
    return {
        name: make_readings_topic(make_batch_schema(name, each))
        for name, each in recorded_devices(session.telemetry_segments).items()
    }


def iterate_recorded_messages(session: Session) -> Iterator[RecordedMessage]:
    """The messages of the telemetry as `list_topics` has them: those of a device that was declared otherwise in a
    part of the session are encoded again."""
    forms = {name: make_batch_schema(name, each) for name, each in recorded_devices(session.telemetry_segments).items()}
    for path in session.telemetry_segments:
        for message in read_telemetry_messages(path, lambda channel: True):
            form = message.form
            if form is not None and form is not forms[form.name]:
                whole = forms[form.name]
                data = whole.encode(form.decode(message.data, message.time_ns))
                message = replace(message, data=data, form=whole)
            yield message
