"""A process that works a queue and is killed when its run has finished so many steps:
`python -m tests.stand.killed_queue DIRECTORY STEPS`."""

import asyncio
import os
import signal
import sys
from pathlib import Path
from typing import NoReturn

from thermostand.foundation.clock import WallClock
from thermostand.stand.queueing.queue_file import Entry
from thermostand.stand.queueing.queue_work import Notes, work


async def run(entry: Entry, notes: Notes) -> NoReturn:
    await notes.begun(Path(sys.argv[1]) / "night")
    for _ in range(int(sys.argv[2])):
        notes.step_done()
    await asyncio.sleep(0)
    await notes.begun(Path(sys.argv[1]) / "night")  # written after the steps, and on the disk now
    os.kill(os.getpid(), signal.SIGKILL)
    raise SystemExit("it lives")


def main() -> None:
    asyncio.run(work(Path(sys.argv[1]), run, WallClock(), print))
