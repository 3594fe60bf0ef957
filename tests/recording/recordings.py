"""A session as a recorder writes it in virtual time."""

import asyncio
import math
from contextlib import suppress

import numpy as np
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory

from tests.recording.device_declarations import declare_devices
from tests.recording.disks import limit_files
from thermostand.foundation.clock import NS_PER_S, VirtualClock
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event, StepMark, StepState
from thermostand.foundation.readings import Frame, Reading, bad_reading
from thermostand.recording.writing.recorder import Recorder, RecordingSettings, SessionInfo

START_NS = 1_767_290_400 * NS_PER_S
INFO = SessionInfo("cycle-1", "thermal_cycle", "DA1234567", "M. Adamczyk", "0.1.0", "virtual")
ATTACHMENTS = {"config.yaml": "camera:\n  gain_dB: 0.0\n", "target.yaml": "rows: 6  # µm\n"}
SETTINGS = RecordingSettings(stop_frames_below_bytes=0, alert_below_fraction=0.0)  # whatever this disk has
DEVICES = declare_devices(
    {
        "thermometers": "thermometers",
        "regulator": "regulator",
        "relays": "relays",
        "camera": "camera",
        "linear": "axis",
        "rotary": "axis",
        "flap": "flap",
    }
)


def batch(device, time_ns, **values):
    units = {"position": {"linear": "mm", "rotary": "deg"}.get(device, "1"), "current": "mA", "mv_heat": "%"}
    flags = ("moving", "homed", "running", "compressor")
    readings = []
    for name, value in values.items():
        unit = "1" if name in flags else units.get(name, "degC")
        channel = f"{device}.{name}"
        broken = math.isnan(value)
        readings.append(
            bad_reading(channel, unit, time_ns, "sensor break") if broken else Reading(channel, value, unit, time_ns)
        )
    return Batch(device, time_ns, tuple(readings))


def frame(time_ns, block_id, shape=(40, 60)):
    image = np.random.default_rng(block_id).integers(0, 255, shape, np.uint8)
    return Frame("camera.image", image, time_ns, 0.1, 0.0, 40.0 + block_id, block_id, 1000 * block_id, 0, "capture-1")


def one_second(time_ns, index):
    """What a stand publishes in a second."""
    yield batch("thermometers", time_ns, air=20 + index / 10, artifact=math.nan if index == 3 else 21.0)
    yield batch("regulator", time_ns, pv=20.0, sp=25.0, mv_heat=12.5, running=1.0)
    yield batch("linear", time_ns, position=100.0 + index, moving=0.0, homed=1.0)
    yield batch("rotary", time_ns, position=30.0, moving=0.0, homed=1.0)
    yield batch("flap", time_ns, position=1.0, current=35.0)
    yield StepMark(time_ns, f"step-{index}", index, "capture", StepState.STARTED, {"frames": 1, "interval_s": 0.5})
    yield frame(time_ns, index)
    yield Event(time_ns, "info", "note", f"second {index}")


async def record(directory, seconds=5, items=one_second, settings=SETTINGS, info=INFO, between=None):
    """Publish `items(time_ns, index)` each virtual second; `between(index)` may do something to the disk. Returns all
    events published, the recorder's own among them."""
    clock, hub, events = VirtualClock(START_NS), Hub(), []
    hub.subscribe(lambda item: events.append(item) if isinstance(item, Event) else None)
    recorder = Recorder(directory, info, ATTACHMENTS, DEVICES, hub, clock, settings=settings)
    recorder.start()
    tasks = [asyncio.create_task(recorder.run()), asyncio.create_task(clock.run())]
    try:
        for index in range(seconds):
            await clock.sleep_until(START_NS + index * NS_PER_S + NS_PER_S // 2)
            if between is not None:
                between(index)
            for item in items(clock.now_ns(), index):
                hub.publish(item)
        await clock.sleep_until(START_NS + seconds * NS_PER_S + 1)
        tasks[0].cancel()
        with suppress(asyncio.CancelledError):
            await tasks[0]
        await recorder.finish()
    finally:
        limit_files()  # before pytest writes its own output, which may be a longer file
    tasks[1].cancel()
    return events


def committed_event_texts(directory):
    """The events in all telemetry segments, finished or not, with a reader that needs no index."""
    decoder = DecoderFactory()
    for path in sorted((directory / "telemetry").iterdir()):
        schemas, channels = {}, {}
        with path.open("rb") as file, suppress(Exception):  # an unfinished file ends anywhere
            for part in StreamReader(file, validate_crcs=True).records:
                if isinstance(part, Message) and channels[part.channel_id].topic == "/experiment/event":
                    schema = schemas[channels[part.channel_id].schema_id]
                    yield decoder.decoder_for("protobuf", schema)(part.data).text
                elif type(part).__name__ == "Schema":
                    schemas[part.id] = part
                elif type(part).__name__ == "Channel":
                    channels[part.id] = part


async def start(directory, settings, encode=None):
    """A recorder that runs on a virtual clock; returns it, its clock, its hub and its tasks."""
    clock, hub = VirtualClock(START_NS), Hub()
    recorder = Recorder(directory, INFO, ATTACHMENTS, DEVICES, hub, clock, settings=settings, prepare=encode)
    recorder.start()
    return recorder, clock, hub, [asyncio.create_task(recorder.run()), asyncio.create_task(clock.run())]


async def stop(tasks):
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
