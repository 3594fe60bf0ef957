"""What a power cut leaves at the end of an unfinished segment, and what it cannot have left."""

from collections import namedtuple
from pathlib import Path

import pytest

from tests.recording.damage import names, read_segment, write_segment
from thermostand.foundation.errors import SessionError
from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.reading.scan import verify
from thermostand.recording.repair.salvage import salvage_session

SERIES = [TELEMETRY, FRAMES]
COUNT = 20
Left = namedtuple("Left", "folder part written")


@pytest.fixture(params=SERIES)
def left(request, tmp_path):
    """A segment of twenty blocks that was not finished."""
    folder: Path = tmp_path / "cycle" / request.param
    written = write_segment(folder, request.param, range(COUNT))
    return Left(folder, folder / "0000.mcap.part", written)


def zeros_from(data, begin):
    return data[:begin] + bytes(len(data) - begin)


def garbage_from(data, begin):
    return data[:begin] + b"\xa5" * (len(data) - begin)


def is_sound(directory):
    try:
        return verify(directory).is_sound
    except SessionError:
        return False


@pytest.mark.parametrize("blocks", [2, 3, 8, COUNT - 1])
@pytest.mark.parametrize("into", [0, 5, 9, 60, -5], ids=["block", "head", "behind head", "content", "index before"])
@pytest.mark.parametrize("change", [zeros_from, garbage_from])
def test_more_than_one_block_of_zeros_or_garbage_was_acknowledged_and_is_a_loss(left, blocks, into, change):
    data = change(left.written.data, left.written.blocks[-blocks].begin + into)
    left.part.write_bytes(data)
    (done,) = salvage_session(left.folder.parent)
    assert done.lost_bytes > 0
    assert done.kept == left.folder / "0000.mcap.damaged"
    assert done.kept.read_bytes() == data
    assert read_segment(done.path) == left.written.untouched(data)
    assert not is_sound(left.folder.parent)


def test_zeros_over_every_block_are_a_loss(left):
    left.part.write_bytes(zeros_from(left.written.data, left.written.opening_bytes) + bytes(1 << 16))
    (done,) = salvage_session(left.folder.parent)
    assert done.lost_bytes > 0
    assert done.kept is not None


@pytest.mark.parametrize("into", [0, 5, 9, 60, -5], ids=["block", "head", "behind head", "content", "index"])
def test_zeros_over_the_last_block_are_what_a_power_cut_leaves(left, into):
    last = left.written.blocks[-1]
    begin = last.begin + into if into >= 0 else last.end - into
    left.part.write_bytes(zeros_from(left.written.data, begin))
    (done,) = salvage_session(left.folder.parent)
    assert (done.lost_bytes, done.kept) == (0, None)
    assert names(left.folder) == ["0000.mcap"]


def test_the_first_block_may_be_partial_like_any_other(left):
    first = left.written.blocks[0]
    other = FRAMES if left.written.series == TELEMETRY else TELEMETRY
    write_segment(left.folder.parent / other, other, range(3), finish=True)
    for begin in (0, 8, 100, first.begin, first.begin + 9, first.begin + 60, first.end - 5):
        for end in (first.end, left.written.blocks[1].begin):  # with the message indexes, whose size no other tells
            left.part.write_bytes(zeros_from(left.written.data[:end], begin))
            (done,) = salvage_session(left.folder.parent)
            assert (done.lost_bytes, done.kept) == (0, None), (begin, end)


@pytest.mark.parametrize("behind_head", [0, 200])
def test_a_block_larger_than_all_before_is_partial_as_far_as_its_head_tells(left, tmp_path, behind_head):
    small = write_segment(tmp_path / "small" / left.written.series, left.written.series, range(3))
    block = left.written.blocks[0]  # with the schemas
    larger = zeros_from(left.written.data[block.begin : block.end], 9 + behind_head)
    left.part.write_bytes(small.data + larger)
    (done,) = salvage_session(left.folder.parent)
    assert (done.lost_bytes, done.kept) == (0, None)
    assert read_segment(done.path) == small.messages
