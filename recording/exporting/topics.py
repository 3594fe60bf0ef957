"""What the telemetry of a recorded session consists of: its topics, the devices on them, and its messages."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from mcap.records import Channel

from thermostand.foundation.errors import SessionError
from thermostand.recording.format import messages
from thermostand.recording.format.batches import READINGS, RecordedDevice, batch_form, form_of
from thermostand.recording.format.damage import reading
from thermostand.recording.format.layout import TELEMETRY
from thermostand.recording.format.records import RecordedMessage, telemetry_messages
from thermostand.recording.format.summary import read_summary
from thermostand.recording.reading.session import Session
from thermostand.recording.writing.forms import readings_topic
from thermostand.recording.writing.segment import Topic


def recorded_topics(session: Session) -> tuple[Topic, ...]:
    """The topics of all telemetry segments in the order they were declared; SessionError when one is unknown."""
    topics = {f"{READINGS}{name}": each for name, each in _readings_topics(session).items()}
    for channel in _channels(session):
        if channel.topic in topics:
            continue
        if channel.topic not in messages.CLASSES:
            raise SessionError(f"{session.path}: was recorded by another version; its topic {channel.topic} is unknown")
        topics[channel.topic] = Topic(channel.topic, messages.CLASSES[channel.topic])
    return tuple(topics.values())


def _readings_topics(session: Session) -> dict[str, Topic]:
    return {name: readings_topic(batch_form(name, each)) for name, each in recorded_devices(session).items()}


def recorded_devices(session: Session) -> dict[str, RecordedDevice]:
    """The devices by name, each with all that it was declared to measure in any part of the session."""
    found: dict[str, RecordedDevice] = {}
    for channel in _channels(session):
        if channel.topic.startswith(READINGS):
            form = form_of(channel.metadata)
            before = found[form.name].channels if form.name in found else ()
            known = [(each.name, each.unit) for each in before]
            added = (each for each in form.device.channels if (each.name, each.unit) not in known)
            found[form.name] = RecordedDevice(form.device.kind, (*before, *added))
    return found


def recorded_messages(session: Session) -> Iterator[RecordedMessage]:
    """The messages of the telemetry as `recorded_topics` has them: those of a device that was declared otherwise in a
    part of the session are encoded anew."""
    forms = {name: batch_form(name, each) for name, each in recorded_devices(session).items()}
    for path in session.telemetry_segments:
        for message in telemetry_messages(path, lambda channel: True):
            form = message.form
            if form is not None and form is not forms[form.name]:
                whole = forms[form.name]
                data = whole.encode(form.decode(message.data, message.time_ns))
                message = replace(message, data=data, form=whole)
            yield message


def _channels(session: Session) -> list[Channel]:
    """The channels of each telemetry segment, from its index."""
    channels: list[Channel] = []
    for path in session.segments:
        if path.parent.name != TELEMETRY:
            continue
        with reading(path), path.open("rb") as file:
            numbered = read_summary(file, path.stat().st_size).channels()
        channels += [numbered[number][0] for number in sorted(numbered)]
    return channels
