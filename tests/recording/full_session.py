"""A session with everything in it, recorded in virtual time, and ways to compare two sessions message by message."""

import asyncio
from contextlib import suppress
from typing import Any

import numpy as np

from tests.recording.device_declarations import declare_devices
from thermostand.foundation.clock import NS_PER_S, VirtualClock
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event, StepMark, StepState
from thermostand.foundation.readings import Channel, Frame, Quality, Reading, bad_reading
from thermostand.recording.format.batches import RecordedDevice
from thermostand.recording.format.images import FrameEncoding
from thermostand.recording.format.layout import TELEMETRY
from thermostand.recording.format.records import list_frame_places, read_frame, read_telemetry_messages
from thermostand.recording.writing.recorder import Recorder, RecordingSettings, SessionInfo

START_NS = 1_767_290_400 * NS_PER_S + 123_456_789
MS = 1_000_000
INFO = SessionInfo("cycle-1", "thermal_cycle", "DA1234567", "M. Adamczyk", "0.1.0", "wall", host="laboratory")
ATTACHMENTS = {"config.yaml": "camera:\n  gain_dB: 0.0\n", "target.yaml": "rows: 6  # µm\r\n"}
DEVICES = declare_devices({"thermometers": "thermometers", "regulator": "regulator", "camera": "camera"})
DEVICES |= declare_devices({"rotary": "axis", "linear": "axis"})
_PUBLISHED = {
    "thermometers": (Channel("air", "degC"), Channel("artifact", "degC")),
    "regulator": (Channel("pv", "degC"),),
    "linear": (Channel("position", "mm", "position"),),
    "rotary": (Channel("position", "deg", "position"),),
}
PUBLISHED = {name: RecordedDevice(DEVICES[name].kind, channels) for name, channels in _PUBLISHED.items()}
"""What `make_half_second` has readings of, and nothing else."""


def frame(time_ns, index, dtype=np.uint8):
    image = np.random.default_rng(index).integers(0, np.iinfo(dtype).max, (30, 40), dtype)
    camera_degC = np.nan if index == 3 else 40.0 + index / 3
    return Frame(
        "camera.image",
        image,
        time_ns,
        0.1,
        1.5,
        camera_degC,
        2**40 + index,
        1000 * index,
        index % 2,
        f"capture-{index}",
    )


def make_half_second(time_ns, index, dtype: Any = np.uint8):
    """What a stand publishes in half a second, the frame after the middle of its exposure."""
    air = Reading("thermometers.air", 20 + index / 7, "degC", time_ns - 3 * MS)
    if index == 4:
        air = bad_reading("thermometers.air", "degC", time_ns - 3 * MS, 'sensor break; "open", line\n2')
    artifact = Reading("thermometers.artifact", 0.1 + 0.2, "degC", time_ns - MS, Quality.STALE, "not confirmed")
    yield Batch("thermometers", time_ns, (air, artifact))
    yield Batch("regulator", time_ns, (Reading("regulator.pv", 21.0 + index, "degC", time_ns),))
    yield StepMark(time_ns, f"capture-{index}", index, "capture", StepState.STARTED, {"frames": 1, "interval_s": 0.5})
    yield Batch("linear", time_ns, (Reading("linear.position", 100.0 + index, "mm", time_ns),))
    yield Batch("rotary", time_ns, (Reading("rotary.position", 1e-17 * index, "deg", time_ns),))
    yield frame(time_ns - 50 * MS, index, dtype)
    yield StepMark(time_ns, f"capture-{index}", index, "capture", StepState.DONE, {"frames": 1, "interval_s": 0.5})
    yield Event(time_ns, "warning", "note", f"half second {index}, 5 µm")


async def record(
    directory,
    count=12,
    items=make_half_second,
    encoding: FrameEncoding = "zstd",
    segment_s=2.0,
    period_ns=NS_PER_S // 2,
    attachments=ATTACHMENTS,
    devices=DEVICES,
):
    """Publish `items(time_ns, index)` each period; returns all that were published."""
    clock, hub, published = VirtualClock(START_NS), Hub(), []
    settings = RecordingSettings(encoding, telemetry_commit_s=1.0, segment_s=segment_s)
    recorder = Recorder(directory, INFO, attachments, devices, hub, clock, settings=settings)
    hub.subscribe(published.append)
    recorder.start()
    tasks = [asyncio.create_task(recorder.run()), asyncio.create_task(clock.run())]
    for index in range(count):
        await clock.sleep_until(START_NS + index * period_ns)
        for item in items(clock.now_ns(), index):
            hub.publish(item)
    await clock.sleep_until(START_NS + count * period_ns)
    for task in tasks:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
    await recorder.finish()
    return published


def telemetry(session):
    """Every telemetry message as it is in the files, in their order."""
    paths = (path for path in session.segments if path.parent.name == TELEMETRY)
    return [message for path in paths for message in read_telemetry_messages(path, lambda channel: True)]


def images(session):
    """The two messages of every frame as they are in the files, in their order."""
    places = [place for path in session.frame_segments for place in list_frame_places(path)]
    return [(frame.meta, bytes(frame.image)) for frame in map(read_frame, places)]


def frame_key(frame):
    """A frame as something that can be compared; NaN equals NaN."""
    fields = ("channel", "time_ns", "exposure_s", "gain_dB", "camera_degC", "block_id", "camera_ticks", "dropped")
    values = [repr(getattr(frame, name)) for name in (*fields, "step_id")]
    windows = None if frame.windows is None else frame.windows.tolist()
    return (*values, str(frame.image.dtype), frame.image.shape, frame.image.tobytes(), windows)


def item_key(item):
    """An item as something that can be compared."""
    return frame_key(item) if isinstance(item, Frame) else repr(item)
