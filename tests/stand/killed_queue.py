"""A process that works a queue and is killed when its run has finished so many steps:
`python -m tests.stand.killed_queue DIRECTORY STEPS`."""

import asyncio
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from thermostand.foundation.clock import Now, WallClock
from thermostand.foundation.shutdown_deadline import ShutdownDeadline
from thermostand.recording.writing.disk import QUEUE_LINE, DiskCalls, DiskProcess
from thermostand.stand.service.queue_file import QueueEntry, lock_worker
from thermostand.stand.service.queue_worker import RunNotes, RunOne, drain


async def work(directory: Path, run_one: RunOne, clock: Now, tell: Callable[[str], None]) -> None:
    """The queue of a folder, by a process for its disk as a daemon has one."""
    disk = DiskProcess()
    calls = DiskCalls(disk, QUEUE_LINE, WallClock())
    try:
        with lock_worker(directory):
            await drain(directory, run_one, clock, tell, calls, ShutdownDeadline())
    finally:
        calls.close()
        disk.close()


async def run(entry: QueueEntry, notes: RunNotes) -> NoReturn:
    await notes.begun(Path(sys.argv[1]) / "cycle")
    for _ in range(int(sys.argv[2])):
        notes.step_done()
    await asyncio.sleep(0)
    await notes.begun(Path(sys.argv[1]) / "cycle")  # written after the steps, and on the disk now
    os.kill(os.getpid(), signal.SIGKILL)
    raise SystemExit("it lives")


def main() -> None:
    asyncio.run(work(Path(sys.argv[1]), run, WallClock(), print))
