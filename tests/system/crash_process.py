"""Everything a run keeps on its disk, written until killed: `python -m tests.system.crash_process FOLDER MARKS`.

Frames and telemetry with a disk process as in a real run, the run's journal, the queue's file and the compressor's.
After each acknowledgement a line of JSON goes to MARKS: how much of each is acknowledged by then. A control is written
each time, too, and never synced.
"""

import asyncio
import json
import os
import sys
from pathlib import Path

from tests.recording.device_declarations import declare_devices
from tests.system.recording_process import INFO, MESSAGES_PER_ROUND, SETTINGS, batches_of, frame_of
from thermostand.foundation.clock import NS_PER_S, WallClock
from thermostand.foundation.hub import Hub
from thermostand.recording.writing.disk import DiskProcess
from thermostand.recording.writing.recorder import Recorder
from thermostand.stand.chamber.compressor import CompressorState, save_state
from thermostand.stand.running.memory.entries import Begun, Soaked
from thermostand.stand.running.memory.journal import Journal
from thermostand.stand.service.queue_file import change_queue

SESSION, QUEUE, COMPRESSOR, CONTROL = "session", "runs", "state/compressor.json", "control"
PAUSE_S = 0.005


def journal_entry(index):
    return Begun(0, "cycle-1", "0f", {}) if index == 0 else Soaked(index, f"soak-{index}", float(index))


def compressor_state(index):
    return CompressorState(running=False, since_ns=index * NS_PER_S, starts_ns=(index,))


class Marks:
    """What is acknowledged: of each thing that is kept, how many."""

    def __init__(self, path, control):
        self.path, self.control = os.open(path, os.O_WRONLY), control.open("ab", buffering=0)
        self.counts: dict[str, int] = dict.fromkeys(
            ("rounds", "frames", "telemetry", "journal", "queue", "compressor", "control"), 0
        )

    def note(self, **counts):
        if all(self.counts[name] == count for name, count in counts.items()):
            return
        self.control.write(b"x")
        self.counts |= counts | {"control": self.counts["control"] + 1}
        os.pwrite(self.path, json.dumps(self.counts).encode() + b"\n", 0)


async def record_rounds(recorder, hub, marks):
    """One round after the other, each when all of the one before is acknowledged."""
    rounds = 0
    while True:
        saved = recorder.saved
        marks.note(rounds=rounds, frames=saved.frames, telemetry=saved.telemetry)
        if (saved.frames, saved.telemetry) == (rounds, rounds * MESSAGES_PER_ROUND):
            marks.note(rounds=rounds + 1)
            hub.publish(frame_of(rounds))
            for batch in batches_of(rounds):
                hub.publish(batch)
            rounds += 1
        await asyncio.sleep(0.001)


async def write_journal(journal, marks):
    for index in range(1_000_000):
        await journal.write(journal_entry(index))
        marks.note(journal=index + 1)
        await asyncio.sleep(PAUSE_S)


async def fill_queue(folder, marks):
    for index in range(1, 1_000_000):
        await asyncio.to_thread(note_in_queue, folder, index)
        marks.note(queue=index)
        await asyncio.sleep(PAUSE_S)


def note_in_queue(folder, index):
    with change_queue(folder) as draft:
        draft.set(halted=str(index))


async def write_compressor_state(path, marks):
    for index in range(1, 1_000_000):
        await asyncio.to_thread(save_state, path, compressor_state(index), None)
        marks.note(compressor=index)
        await asyncio.sleep(PAUSE_S)


async def main(folder, marks_path):
    clock, hub, disk = WallClock(), Hub(), DiskProcess()
    marks = Marks(marks_path, folder / CONTROL)
    (folder / QUEUE).mkdir()
    texts, devices = {"config.yaml": "a: 1\n"}, declare_devices({"thermometers": "thermometers"})
    recorder = Recorder(folder / SESSION, INFO, texts, devices, hub, clock, settings=SETTINGS, disk=disk)
    await recorder.begin(tuple)
    journal = Journal.create(folder / SESSION)
    journal.start(clock, print, disk)
    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(recorder.run())
        tasks.create_task(record_rounds(recorder, hub, marks))
        tasks.create_task(write_journal(journal, marks))
        tasks.create_task(fill_queue(folder / QUEUE, marks))
        tasks.create_task(write_compressor_state(folder / COMPRESSOR, marks))


if __name__ == "__main__":
    asyncio.run(main(Path(sys.argv[1]), Path(sys.argv[2])))
