"""What the telemetry of a recorded session consists of: its topics and the devices on them."""

from __future__ import annotations

from mcap.records import Channel

from thermostand.foundation.errors import SessionError
from thermostand.recording.format import messages
from thermostand.recording.format.damage import reading
from thermostand.recording.format.layout import DEVICES, TELEMETRY
from thermostand.recording.format.summary import read_summary
from thermostand.recording.reading.session import Session
from thermostand.recording.writing.segment import Topic


def recorded_topics(session: Session) -> tuple[Topic, ...]:
    """The topics of all telemetry segments in the order they were declared; SessionError when one is unknown."""
    devices: dict[str, dict[str, None]] = {}  # topic -> names, in order
    for channel in _channels(session):
        if channel.topic not in messages.CLASSES:
            raise SessionError(f"{session.path}: was recorded by another version; its topic {channel.topic} is unknown")
        names = channel.metadata.get(DEVICES, "").split(",")
        devices.setdefault(channel.topic, {}).update(dict.fromkeys(name for name in names if name))
    return tuple(Topic(name, messages.CLASSES[name], tuple(devices[name])) for name in devices)


def recorded_devices(session: Session) -> dict[str, str]:
    """Device name -> its kind, as it was recorded."""
    kind_of_topic = {kind.topic: name for name, kind in messages.KINDS.items()}
    return {
        device: kind_of_topic[topic.name]
        for topic in recorded_topics(session)
        if topic.name in kind_of_topic
        for device in topic.devices
    }


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
