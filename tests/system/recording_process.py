"""Recordings in processes of their own, to be ended without warning.

A nursery (`python -m tests.system.recording_process`) imports everything once and forks a recording for each directory
it reads from its standard input; so one costs milliseconds. A recording publishes one round after the other, each when
all of the one before is acknowledged, and writes after each look how far it is.
"""

import asyncio
import os
import signal
import struct
import subprocess
import sys
import threading
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.recording.device_declarations import declare_devices
from tests.recording.device_declarations import form as declared_form
from tests.recording.frame_records import make_frame_records
from thermostand.foundation.clock import NS_PER_S, WallClock
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch
from thermostand.foundation.readings import Frame, Reading
from thermostand.recording.writing.recorder import Recorder, RecordingSettings, SessionInfo
from thermostand.recording.writing.segment import MessageRecord

START_NS = 1_767_290_400 * NS_PER_S
PERIOD_NS = NS_PER_S // 100
INFO = SessionInfo("cycle-1", "warm_up", "DA1234567", "M. Adamczyk", "0.1.0", "wall", host="laboratory")
SETTINGS = RecordingSettings(
    telemetry_commit_s=0.002,
    segment_bytes=40_000,  # a dozen frames
    segment_s=0.3,
    stop_frames_below_bytes=0,
    alert_below_fraction=0.0,
)
BATCHES = 2
MESSAGES_PER_ROUND = BATCHES
ENCODER = declared_form("thermometers")
PROGRESS = struct.Struct("<QQQQ")  # process (0: it has ended), rounds published, frames and messages saved


def frame_of(index):
    image = np.random.default_rng(index).integers(0, 255, (40, 60), np.uint8)
    return Frame("camera.image", image, START_NS + index * PERIOD_NS, 0.1, 0.0, 41.0, index, 7 * index)


def batches_of(index):
    for part in range(BATCHES):
        time_ns = START_NS + index * PERIOD_NS + part + 1
        yield Batch("thermometers", time_ns, (Reading("thermometers.air", 20 + index / 8 + part, "degC", time_ns),))


def frame_records(count):
    """What the images of the first rounds are on the disk."""
    return images_in(record for index in range(count) for record in make_frame_records(frame_of(index)))


def images_in(records):
    """Of the records of frames the images, which are the same in each recording."""
    return [record._replace(published_ns=0) for record in records if record.topic.endswith("/image")]


def telemetry_records(rounds):
    """The same for the telemetry."""
    records = []
    for index in range(rounds):
        records += [MessageRecord(ENCODER.topic, batch.time_ns, ENCODER.encode(batch)) for batch in batches_of(index)]
    return records


async def record(directory):
    """Record until killed; progress goes to the standard output."""
    clock, hub = WallClock(), Hub()
    recorder = Recorder(
        directory,
        INFO,
        {"config.yaml": "a: 1\n"},
        declare_devices({"thermometers": "thermometers"}),
        hub,
        clock,
        settings=SETTINGS,
    )
    recorder.start()
    running = asyncio.create_task(recorder.run())
    rounds = 0
    while not running.done():
        saved = recorder.saved
        os.write(1, PROGRESS.pack(os.getpid(), rounds, saved.frames, saved.telemetry))
        if (saved.frames, saved.telemetry) == (rounds, rounds * MESSAGES_PER_ROUND):
            hub.publish(frame_of(rounds))
            for batch in batches_of(rounds):
                hub.publish(batch)
            rounds += 1
        await asyncio.sleep(0.001)
    running.result()


def main():
    """The nursery; one recording at a time."""
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            asyncio.run(record(Path(line.strip())))
            os._exit(1)
        os.waitpid(child, 0)
        os.write(1, PROGRESS.pack(0, 0, 0, 0))


@dataclass(frozen=True)
class Progress:
    """The last word of a recording: rounds published, frames and telemetry messages acknowledged."""

    rounds: int
    frames: int
    messages: int


class Recording:
    """One running recording."""

    def __init__(self, nursery, directory):
        self._output = nursery.stdout
        nursery.stdin.write(f"{directory}\n".encode())
        nursery.stdin.flush()
        self.last = Progress(0, 0, 0)
        while not (self.last.frames and self.last.messages):
            self.pid = self._read()
            assert self.pid, "the recording ended by itself"

    def _read(self):
        pid, rounds, frames, count = PROGRESS.unpack(self._output.read(PROGRESS.size))
        if pid:
            self.last = Progress(rounds, frames, count)
        return pid

    def wait(self, duration_s):
        """Let it record for that long."""
        threading.Event().wait(duration_s)

    def stop(self):
        """Stopped in the middle of whatever it does when this returns."""
        os.kill(self.pid, signal.SIGSTOP)
        while Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()[0] != "T":
            pass

    def kill(self):
        """Dead when this returns; its last word."""
        os.kill(self.pid, signal.SIGKILL)
        while self._read():
            pass
        return self.last


@contextmanager
def nursery():
    """`start(directory)` gives a Recording that has acknowledged its first frame and telemetry."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    command = [sys.executable, "-m", "tests.system.recording_process"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment) as process:
        try:
            yield lambda directory: Recording(process, directory)
        finally:
            process.stdin.close()
            process.stdout.close()
            process.terminate()


if __name__ == "__main__":
    main()
