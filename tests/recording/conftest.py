"""A session with a finished segment and one that was not finished in each series, and damaged copies of it."""

import tempfile
from pathlib import Path

import pytest

from tests.recording.damage import (
    copy_session,
    write_segment,
)
from thermostand.recording.format.layout import FRAMES, TELEMETRY


@pytest.fixture(scope="module")
def memory():
    """A folder that costs no disk syncs."""
    shm = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=shm if shm.is_dir() else None) as folder:
        yield Path(folder)


@pytest.fixture(scope="module")
def intact(memory):
    """A finished segment and one that was not finished in each series: the directory and what was written where."""
    directory = memory / "cycle"
    written = {}
    for series, seconds in ((TELEMETRY, 60), (FRAMES, 24)):
        folder = directory / series
        written[series, "finished"] = write_segment(folder, series, range(seconds), finish=True)
        written[series, "part"] = write_segment(folder, series, range(seconds, 2 * seconds))
    return directory, written


@pytest.fixture
def damaged(memory, intact):
    """`damaged(series, change, of)`: a copy of the session in which `change(data)` has been done to the part, or to the
    finished segment, and all others are finished; gives its folder, its path and what was written."""

    def make(series, change, of="part"):
        directory, written = intact
        folder = copy_session(directory, memory / "copy") / series
        path = folder / ("0001.mcap.part" if of == "part" else "0000.mcap")
        for part in folder.parent.glob("*/*.part"):
            part.unlink()
        path.write_bytes(change(written[series, of].data))
        return folder, path, written[series, of]

    return make
