"""A daemon that records in real time with a disk process, without a stand: `python -m tests.system.disk_daemon FOLDER`.

Each 20 ms an event and a frame are published, each 100 ms a line is written into the journal; it says the disk
process's id, then when it looks, how much is acknowledged and how old what waits is. SIGTERM ends it, as the end of a
run does.
"""

import asyncio
import signal
import sys
import time
from pathlib import Path

import numpy as np

from thermostand.foundation.clock import NS_PER_S, WallClock
from thermostand.foundation.errors import SessionError
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event
from thermostand.foundation.readings import Frame
from thermostand.foundation.shutdown_deadline import ShutdownDeadline
from thermostand.recording.writing.disk import DiskProcess
from thermostand.recording.writing.recorder import FINISH_WITHIN_S, Recorder, RecordingSettings, SessionInfo
from thermostand.stand.running.memory.entries import Begun, Ended, Soaked
from thermostand.stand.running.memory.journal import Journal, Logbook
from thermostand.stand.running.memory.state import RunState

INFO = SessionInfo("cycle-1", "warm_up", "DA1234567", "", "0.1.0", "wall")
SETTINGS = RecordingSettings("raw", telemetry_commit_s=0.05, stop_frames_below_bytes=0, alert_below_fraction=0.0)
IMAGE = np.zeros((100, 100), np.uint8)


def say(*words):
    sys.stdout.write("\t".join(map(str, words)) + "\n")
    sys.stdout.flush()


async def publish(hub, clock, journal):
    number = 0
    while True:
        now_ns = clock.now_ns()
        hub.publish(Event(now_ns, "info", "note", str(number)))
        hub.publish(Frame("camera.image", IMAGE, now_ns, 0.1, 0.0, 40.0, number, number))
        if number % 5 == 0:
            journal.note(Soaked(now_ns, "a1", float(number)))
        number += 1
        await asyncio.sleep(0.02)


async def main(directory):
    clock, hub, disk, stopped = WallClock(), Hub(), DiskProcess(), asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stopped.set)
    recorder = Recorder(directory, INFO, {}, {}, hub, clock, settings=SETTINGS, disk=disk)
    await recorder.begin(tuple)
    recording = asyncio.create_task(recorder.run())
    log, journal = Logbook(hub, clock, RunState(())), Journal.create(directory)
    await log.begin(journal, Begun(clock.now_ns(), "cycle-1", "0f", {}), disk=disk)
    recorder.watch_file(journal)
    publishing = asyncio.create_task(publish(hub, clock, journal))
    say(disk.pid)
    while not stopped.is_set():
        since_ns = recorder.waiting_since_ns
        age_s = 0.0 if since_ns is None else (clock.now_ns() - since_ns) / NS_PER_S
        say(time.monotonic(), recorder.saved.frames, recorder.saved.telemetry, age_s, recorder.folder_lost)
        await asyncio.sleep(0.02)
    publishing.cancel()
    deadline = ShutdownDeadline()
    deadline.begin()
    try:
        try:
            await log.end(Ended(0, "stopped", "stopped"), deadline)
        finally:
            recording.cancel()
            await asyncio.wait([recording])
            await recorder.finish(FINISH_WITHIN_S / 4, deadline)
    finally:
        disk.close()


if __name__ == "__main__":
    try:
        asyncio.run(main(Path(sys.argv[1])))
    except SessionError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(3)
