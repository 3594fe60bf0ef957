"""Which devices a session has recorded, and what each was declared to measure."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from mcap.records import Channel

from thermostand.recording.format.batches import READINGS, RecordedDevice, parse_batch_schema
from thermostand.recording.format.damage import convert_damage
from thermostand.recording.format.mcap_contents import find_rewritten
from thermostand.recording.format.summary import read_summary


def recorded_devices(telemetry: Iterable[Path]) -> dict[str, RecordedDevice]:
    """The devices of these telemetry segments by name, each with all that it was declared to measure in any of them;
    SessionError when the index of one cannot be read."""
    found: dict[str, RecordedDevice] = {}
    for channel in recorded_channels(telemetry):
        if channel.topic.startswith(READINGS):
            form = parse_batch_schema(channel.metadata)
            before = found[form.name].channels if form.name in found else ()
            known = [(each.name, each.unit) for each in before]
            added = (each for each in form.device.channels if (each.name, each.unit) not in known)
            found[form.name] = replace(form.device, channels=(*before, *added))
    return found


def recorded_channels(telemetry: Iterable[Path]) -> list[Channel]:
    """The MCAP channels of each of these segments, from its index; SessionError when it cannot be read."""
    channels: list[Channel] = []
    for path in telemetry:
        with convert_damage(path), path.open("rb") as file:
            rewritten = find_rewritten(path)
            if rewritten is not None:
                numbered = {number: (channel, "") for number, channel in rewritten.channels.items()}
            else:
                numbered = read_summary(file, path.stat().st_size).channels()
        channels += [numbered[number][0] for number in sorted(numbered)]
    return channels
