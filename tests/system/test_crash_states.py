"""The states a disk can have when the power fails, made one by one from its logged writes and flushes.

A disk holds everything that was written before its last flush, and of what was written since any part, in sectors. Each
state is mounted (ext4 replays its journal), salvaged and read: whatever had been acknowledged by then is there. So are
the run's journal, the queue's file and the compressor's. The 200 states are drawn at flushes, right before them, and
between them with only some of the writes.
"""

import json
import os
import random
import shutil
import subprocess
import sys
import threading
from contextlib import contextmanager
from dataclasses import dataclass

import pytest

from tests.system.crash_process import COMPRESSOR, CONTROL, QUEUE, SESSION, journal_entry
from tests.system.logged_disk import FLUSH, LIMIT_S, MARK, WRITE, Entry, logged_disk, read_log
from tests.system.recording_process import frame_records, images_in, telemetry_records
from tests.system.test_kill_recording import read_series
from tests.system.test_power_cut import mounted
from thermostand.foundation.clock import NS_PER_S
from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.reading.session import Session
from thermostand.recording.repair.salvage import salvage_unfinished
from thermostand.stand.chamber.compressor import load_state
from thermostand.stand.running.memory.journal import Journal
from thermostand.stand.service.queue_file import read_queue

STATES = 200
DISK_BYTES = 48 << 20
LOG_BYTES = 24 << 20
SECTOR_BYTES = 512

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.skipif(os.geteuid() != 0, reason="only root can mount a disk"),
    pytest.mark.skipif(shutil.which("mkfs.ext4") is None, reason="needs mkfs.ext4 (e2fsprogs)"),
]


def made_disk(path):
    with path.open("wb") as file:
        file.truncate(DISK_BYTES)
    subprocess.run(["mkfs.ext4", "-q", "-E", "lazy_itable_init=0,lazy_journal_init=0", path], check=True)
    return path


@contextmanager
def crash_process(disk, marks):
    """Running, and killed at the end with its disk process."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    command = [sys.executable, "-m", "tests.system.crash_process", disk, marks]
    with subprocess.Popen(command, env=environment) as process:
        try:
            yield process
        finally:
            process.kill()


def recorded_log(tmp_path, image):
    """What the disk got while a run was recorded on it."""
    log, disk = tmp_path / "log", tmp_path / "disk"
    with logged_disk(tmp_path / "logged", image, log) as logged, mounted(logged / "disk", disk):
        with crash_process(disk, logged / "marks") as process:
            for _ in range(LIMIT_S * 10):
                threading.Event().wait(0.1)
                assert process.poll() is None
                if log.stat().st_size > LOG_BYTES:
                    break
        return read_log(log)  # what the disk gets from here on is of no interest


@dataclass(frozen=True)
class Crash:
    """The power fails when the disk has got the first `end` entries; `kept` says which of the writes since the last
    flush are on it: all, none, or (a seed) some."""

    end: int
    kept: str | int


def crashes(entries, rng):
    """STATES of them in order of time, all after the first frame was acknowledged; as many of each kind."""
    first = next(n for n, entry in enumerate(entries) if acknowledged(entry).get("frames"))
    flushes = [n for n in range(first, len(entries)) if entries[n].kind == FLUSH]
    writes = [n for n in range(first, len(entries)) if entries[n].kind == WRITE]
    drawn = [Crash(rng.choice(flushes) + 1, "none") for _ in range(STATES // 3)]
    drawn += [Crash(rng.choice(flushes), "all") for _ in range(STATES // 3)]
    drawn += [Crash(rng.choice(writes) + 1, rng.getrandbits(32)) for _ in range(STATES - len(drawn))]
    return sorted(drawn, key=lambda crash: crash.end)


def acknowledged(entry):
    return json.loads(entry.data) if entry.kind == MARK else {}


def states(image, entries, drawn, after):
    """For each crash: the disk is in the file `after`, and what had been acknowledged."""
    flushed, counts = 0, {}
    for crash in drawn:
        before = entries[flushed : crash.end]
        last_flush = max((n for n, entry in enumerate(before) if entry.kind == FLUSH), default=-1) + 1
        write(image, before[:last_flush])
        flushed += last_flush
        counts = next((found for entry in reversed(before) if (found := acknowledged(entry))), counts)
        subprocess.run(["cp", "--sparse=always", image, after], check=True)
        since = [entry for entry in before[last_flush:] if entry.kind == WRITE]
        write(after, since if crash.kept == "all" else list(some(since, crash.kept)))
        yield crash, counts


def some(writes, seed):
    """Each write with a chance of one half, some of them cut between two sectors."""
    rng = random.Random(seed)
    for entry in writes:
        if rng.random() < 0.5:
            sectors = rng.randint(1, 2 * len(entry.data) // SECTOR_BYTES)
            yield Entry(WRITE, entry.offset, entry.data[: sectors * SECTOR_BYTES])


def write(image, entries):
    with image.open("r+b") as file:
        for entry in entries:
            if entry.kind == WRITE:
                os.pwrite(file.fileno(), entry.data, entry.offset)


def journal_of(session):
    journal, entries = Journal.open(session)
    journal.release()
    return entries


def compressor_of(path):
    """How often its state had been kept; 0 when nothing can be read."""
    starts_ns = load_state(path, 1_000_000 * NS_PER_S, None).starts_ns
    return starts_ns[0] if starts_ns else 0


def test_nothing_acknowledged_is_missing_in_any_state_of_the_disk(tmp_path):
    image, after = made_disk(tmp_path / "image"), tmp_path / "after"
    entries = recorded_log(tmp_path, image)
    drawn = crashes(entries, random.Random(7))
    rounds = max(acknowledged(entry).get("rounds", 0) for entry in entries)
    all_frames, all_telemetry = frame_records(rounds + 1), telemetry_records(rounds + 1)
    lost_controls = 0
    for number, (crash, counts) in enumerate(states(image, entries, drawn, after)):
        with mounted(after, tmp_path / f"after-{number}-{crash.end}-{crash.kept}") as disk:
            salvage_unfinished(disk)
            session = Session.open(disk / SESSION)
            assert (session.incomplete, session.damaged) == ((), ()), crash
            frames, telemetry = (read_series(disk / SESSION, series) for series in (FRAMES, TELEMETRY))
            frames = images_in(frames)
            assert frames == all_frames[: len(frames)], crash
            assert telemetry == all_telemetry[: len(telemetry)], crash
            assert len(frames) >= counts["frames"], crash
            assert len(telemetry) >= counts["telemetry"], crash
            journal = journal_of(disk / SESSION)
            assert journal == list(map(journal_entry, range(len(journal)))), crash
            assert 0 <= len(journal) - counts["journal"] <= 1, crash
            assert 0 <= int(read_queue(disk / QUEUE).halted or 0) - counts["queue"] <= 1, crash
            assert 0 <= compressor_of(disk / COMPRESSOR) - counts["compressor"] <= 1, crash
            lost_controls += (disk / CONTROL).stat().st_size < counts["control"]
    assert lost_controls > STATES // 2  # what nobody syncs is gone: a file that is written only would be found here
