"""The power fails: what was not on the disk is gone. The disk is a file system in a file, on a loop device; a copy of
that file while the recording is stopped is what the disk would hold, and mounting it replays the journal.

The model loses the page cache. A drive that acknowledges what it has not written is beyond it, and beyond us.
"""

import os
import random
import shutil
import subprocess
from contextlib import contextmanager

import pytest

from tests.system.recording_process import frame_records, images_in, nursery, telemetry_records
from tests.system.test_kill_recording import read_series
from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.reading.session import Session
from thermostand.recording.repair.salvage import salvage_unfinished

CUTS = 12
MOST_CUTS = 3 * CUTS
DISK_BYTES = 256 << 20
CONTROL = b"a frame nobody synced\n" * 1000

pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="only root can mount a disk"),
    pytest.mark.skipif(shutil.which("mkfs.ext4") is None, reason="needs mkfs.ext4 (e2fsprogs)"),
]


@contextmanager
def mounted(image, at):
    at.mkdir()
    command = ["mount", "-t", "ext4", "-o", "loop", image, at]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"no loop device can be mounted here: {done.stderr.strip()}")
    try:
        yield at
    finally:
        subprocess.run(["umount", at], check=True)


def read_after_cut(image, at):
    """The sessions of a disk after the power came back: salvaged, and what is in them; and the control's bytes."""
    with mounted(image, at) as disk:
        salvage_unfinished(disk)
        session = Session.open(disk / "session")
        assert (session.incomplete, session.damaged) == ((), ())
        control = disk / "control"
        frames, telemetry = (read_series(disk / "session", series) for series in (FRAMES, TELEMETRY))
        return frames, telemetry, control.read_bytes() if control.exists() else b""


def power_cut(start, tmp_path, name, wait_s, synced=False):
    """Record, cut, and read what is left: whether the cut took what was not synced. Any other that calls `sync` on this
    machine meanwhile (`synced`: this test does) has put that on the disk, too."""
    image, after = tmp_path / "disk", tmp_path / f"disk-{name}"
    with image.open("wb") as file:
        file.truncate(DISK_BYTES)
    subprocess.run(["mkfs.ext4", "-q", "-E", "lazy_itable_init=1", image], check=True)
    with mounted(image, tmp_path / f"before-{name}") as disk:
        recording = start(disk / "session")
        try:
            (disk / "control").write_bytes(CONTROL)  # written, closed, never synced
            recording.wait(wait_s)
            recording.stop()
            if synced:
                subprocess.run(["sync", "--file-system", disk], check=True)
            subprocess.run(["cp", "--sparse=always", image, after], check=True)
        finally:
            last = recording.kill()
    frames, telemetry, control = read_after_cut(after, tmp_path / f"after-{name}")
    after.unlink()
    frames = images_in(frames)
    assert frames == frame_records(len(frames))
    assert telemetry == telemetry_records(last.rounds + 1)[: len(telemetry)]
    assert len(frames) >= last.frames
    assert len(telemetry) >= last.messages
    return control != CONTROL


def test_nothing_acknowledged_is_missing_after_a_power_cut(tmp_path):
    """After every cut what was acknowledged is there. One that left the control shows little: it is repeated."""
    rng = random.Random(4)
    with nursery() as start:
        assert not power_cut(start, tmp_path, "synced", 0.1, synced=True)
        taken = 0
        for number in range(MOST_CUTS):
            taken += power_cut(start, tmp_path, number, rng.uniform(0, 0.6))
            if taken == CUTS:
                return
    pytest.skip(f"only {taken} of {MOST_CUTS} cuts took what was not synced: somebody on this machine calls sync")
