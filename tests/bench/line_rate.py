"""The whole recorder at the line rate of GigE: 5 MP raw frames, 118 MB/s, a minute, each on the disk before it counts.

Hub, queue, thread, encoder and sink as in a run, on the host's clock, in a process of its own, whose peak memory is
it. Each frame is an array of its own, as a camera gives it, published at absolute deadlines. Then, in turns, as fast
as it goes against a bare loop of pwrite and fdatasync with the same bytes. The minute takes 7.1 GB of the disk.
"""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tests.bench.figures import (
    Figure,
    compare,
    make_absolute,
    measure_in_turns,
    report_progress,
    set_lower_goal,
    set_lower_ratio_goal,
    set_upper_goal,
)
from thermostand.foundation.clock import NS_PER_S, WallClock
from thermostand.foundation.hub import Hub
from thermostand.foundation.readings import Frame
from thermostand.recording.writing.recorder import Recorder, RecordingSettings, SessionInfo

LINE_RATE_MB_S = 118.0
DURATION_S = 60.0
PEAK_LIMIT_MB = 300.0
ROUNDS = 11
FRAMES = 16  # in one measurement; they fit the recorder's queue
IMAGES = [np.random.default_rng(seed).integers(0, 255, (2048, 2448), np.uint8) for seed in range(4)]
FRAME_MB = IMAGES[0].nbytes / 1e6
PULSE_S = 0.01
INFO = SessionInfo("bench", "bench", "", "", "0", "wall")


def figures(directory: Path) -> list[Figure]:
    """MB/s, frames dropped, the event loop's lag and peak memory at line rate; MB/s beside bare writes."""
    report_progress(f"recorder, {DURATION_S:.0f} s at line rate")
    command = [sys.executable, "-m", "tests.bench.line_rate", str(directory)]
    found = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
    return [
        set_lower_goal(
            117.9,
            compare("recorder, raw at line rate", "MB/s", "offered", [found["MB_s"]], [found["offered_MB_s"]]),
        ),
        set_upper_goal(0, make_absolute("recorder at line rate, dropped", "frames", [found["dropped"]])),
        set_upper_goal(PEAK_LIMIT_MB, make_absolute("recorder at line rate, peak memory", "MB", [found["peak_MB"]])),
        make_absolute("recorder at line rate, loop lag p99", "ms", [found["lag_p99_ms"]]),
        set_lower_ratio_goal(
            0.5, compare("recorder, raw as fast as it goes", "MB/s", "bare pwrite, fdatasync", *found["free_MB_s"])
        ),
    ]


class Recording:
    """A recorder under way in `directory`, and frames for it."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._hub = Hub()
        self._clock = WallClock()
        settings = RecordingSettings("raw")
        self.recorder = Recorder(directory, INFO, {}, {}, self._hub, self._clock, settings=settings)
        self._published = 0

    async def begin(self) -> None:
        """Start it, in the running loop."""
        self.recorder.start()
        self._task = asyncio.create_task(self.recorder.run())

    async def end(self) -> None:
        """Finish it and remove what it wrote."""
        self._task.cancel()
        with suppress(asyncio.CancelledError):
            await self._task
        await self.recorder.finish()
        shutil.rmtree(self.directory)

    def publish(self, image: NDArray[np.uint8]) -> None:
        """The next frame, now."""
        number, now_ns = self._published, self._clock.now_ns()
        self._hub.publish(Frame("camera.image", image, now_ns, 0.1, 0.0, 40.0, number, now_ns))
        self._published += 1

    async def at_line_rate(self) -> dict[str, float]:
        """DURATION_S of frames at absolute deadlines, until the last is on the disk."""
        count = round(DURATION_S * LINE_RATE_MB_S / FRAME_MB)
        lags_s: list[float] = []
        pulse = asyncio.create_task(self._pulse(lags_s))
        begin_ns = self._clock.now_ns()
        for number in range(count):
            await self._clock.sleep_until(begin_ns + round(number * FRAME_MB / LINE_RATE_MB_S * NS_PER_S))
            self.publish(IMAGES[number % len(IMAGES)].copy())
        offered_s = (self._clock.now_ns() - begin_ns) / NS_PER_S
        await self.recorder.flush()
        duration_s = (self._clock.now_ns() - begin_ns) / NS_PER_S
        pulse.cancel()
        return {
            "MB_s": self.recorder.saved.frames * FRAME_MB / duration_s,
            "offered_MB_s": count * FRAME_MB / offered_s,
            "dropped": self.recorder.frames_lost,
            "lag_p99_ms": 1e3 * statistics.quantiles(lags_s, n=100)[98],
            "peak_MB": peak_MB(),
        }

    async def _pulse(self, lags_s: list[float]) -> None:
        due_ns = self._clock.now_ns()
        while True:
            due_ns += round(PULSE_S * NS_PER_S)
            await self._clock.sleep_until(due_ns)
            lags_s.append((self._clock.now_ns() - due_ns) / NS_PER_S)

    async def as_fast_as_it_goes(self) -> float:
        """MB/s of FRAMES frames, all published at once."""
        begin_s = time.perf_counter()
        for number in range(FRAMES):
            self.publish(IMAGES[number % len(IMAGES)])
        await self.recorder.flush()
        return FRAMES * FRAME_MB / (time.perf_counter() - begin_s)


def peak_MB() -> float:
    """The largest memory this process has had; getrusage would count that of the process it was forked from, too."""
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) * 1024 / 1e6


def bare_writer(file: int) -> Callable[[], float]:
    """MB/s of FRAMES frames' bytes, written and synced one by one."""

    def write() -> float:
        begin_s = time.perf_counter()
        for number in range(FRAMES):
            os.pwrite(file, IMAGES[number % len(IMAGES)].data, os.fstat(file).st_size)
            os.fdatasync(file)
        return FRAMES * FRAME_MB / (time.perf_counter() - begin_s)

    return write


def main(directory: Path) -> None:
    """The child: measure, and print the numbers as JSON."""
    with asyncio.Runner() as runner:
        paced = Recording(directory / "paced")
        runner.run(paced.begin())
        found: dict[str, object] = dict(runner.run(paced.at_line_rate()))
        runner.run(paced.end())
        free = Recording(directory / "free")
        runner.run(free.begin())
        bare = directory / "bare"
        file = os.open(bare, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        found["free_MB_s"] = measure_in_turns(lambda: runner.run(free.as_fast_as_it_goes()), bare_writer(file), ROUNDS)
        os.close(file)
        bare.unlink()
        runner.run(free.end())
    sys.stdout.write(json.dumps(found))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
