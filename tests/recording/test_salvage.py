import random
import tempfile
from pathlib import Path

import pytest

from stand.recording.layout import FRAMES, TELEMETRY
from stand.recording.salvage import salvage_session
from stand.recording.session import Session
from tests.recording.damage import DAMAGES, fresh, names, read_segment, write_segment

TRIALS = 200


@pytest.fixture(scope="module")
def memory():
    """A folder that costs no disk syncs."""
    shm = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=shm if shm.is_dir() else None) as folder:
        yield Path(folder)


@pytest.fixture(scope="module")
def night(memory):
    """A finished segment and one that was not finished in each series: the directory and what was written where."""
    directory = memory / "night"
    written = {}
    for series, seconds in ((TELEMETRY, 60), (FRAMES, 24)):
        folder = directory / series
        written[f"{series}/0000.mcap"] = write_segment(folder, series, range(seconds), finish=True)
        written[f"{series}/0001.mcap.part"] = write_segment(folder, series, range(seconds, 2 * seconds))
    return directory, written


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("series", [TELEMETRY, FRAMES])
def test_what_is_not_damaged_is_delivered_and_nothing_else(memory, night, series, damage):
    directory, written = night
    original = written[f"{series}/0001.mcap.part"]
    rng = random.Random(f"{series} {damage.__name__}")
    for offset in rng.sample(range(len(original.data)), TRIALS):
        copy = fresh(directory, memory / "copy")
        data = damage(original.data, offset, rng)
        (copy / series / "0001.mcap.part").write_bytes(data)
        salvage_session(copy)
        finished = copy / series / "0001.mcap"
        delivered = read_segment(finished) if finished.exists() else []
        assert delivered == original.untouched(data), f"{damage.__name__} at {offset}"
        assert Session.open(copy).incomplete == ()
        assert names(copy / series)[0] == "0000.mcap"
