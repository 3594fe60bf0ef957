"""Of a session of several cameras each has observations, temperatures and a serial number of its own."""

import asyncio
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

from compensation.history.history import recorded_history
from compensation.observations import observe
from compensation.one_camera import take
from foundation.clock import NS_PER_S, VirtualClock
from foundation.errors import SessionError
from foundation.hub import Hub
from foundation.items import Batch, Item
from foundation.readings import Frame, Reading
from recording.reading.session import Session
from recording.writing.recorder import Recorder, RecordingSettings, SessionInfo

from .conftest import START_NS, TARGET_YAML, published

FRAMES, APART_NS, WARMER_K = 3, 1_000_000, 7.0


def of_both(index: int, time_ns: int) -> Iterator[Item]:
    for item in published(index, time_ns):
        yield item
        if isinstance(item, Frame):
            later_ns = time_ns + APART_NS
            warmer = {"channel": "side.image", "time_ns": later_ns, "camera_degC": item.camera_degC + WARMER_K}
            yield replace(item, **warmer)
            for name, degC in (("camera", item.camera_degC), ("side", item.camera_degC + WARMER_K)):
                yield Batch(name, later_ns, (Reading(f"{name}.temperature", degC, "degC", later_ns),))


async def record(directory: Path) -> None:
    clock, hub = VirtualClock(START_NS), Hub()
    info = SessionInfo(directory.name, "thermal-cycle", "TS-0001, TS-0002", "operator", "0.1.0", "virtual")
    devices = {"thermometers": "thermometers", "camera": "camera", "side": "camera"}
    settings = RecordingSettings(telemetry_commit_s=60.0)
    recorder = Recorder(directory, info, {"target.yaml": TARGET_YAML}, devices, hub, clock, settings)
    recorder.start()
    tasks = [asyncio.create_task(recorder.run()), asyncio.create_task(clock.run())]
    for index in range(FRAMES):
        await clock.sleep_until(START_NS + index * 60 * NS_PER_S)
        for item in of_both(index, clock.now_ns()):
            hub.publish(item)
    await clock.sleep_until(clock.now_ns() + NS_PER_S)
    for task in tasks:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
    await recorder.finish()


def test_each_camera_of_a_session_is_observed_by_its_name(tmp_path: Path):
    path = tmp_path / "night"
    asyncio.run(record(path))
    leading, side = observe(path), observe(path, camera="side")
    assert (side.time_ns - leading.time_ns).tolist() == [APART_NS] * FRAMES
    assert (side.camera_degC - leading.camera_degC).tolist() == pytest.approx([WARMER_K] * FRAMES)
    assert [each.sessions[0].camera_serial for each in (leading, side)] == ["TS-0001", "TS-0002"]
    session = Session.open(path)
    take(session, "side")
    assert recorded_history(session).camera_degC[0] == pytest.approx(leading.camera_degC[0] + WARMER_K, abs=0.5)
    with pytest.raises(SessionError, match="no frames of a camera top; it has those of camera, side"):
        observe(path, camera="top")
