"""What a salvage delivers of damaged segments, and where it takes what a segment does not say."""

import random
import re

import pytest

from tests.nightly import mark_nightly
from tests.recording.damage import (
    ATTACHMENTS,
    DAMAGES,
    METADATA,
    TOPICS,
    hole,
    metadata_of,
    names,
    read_segment,
    write_segment,
)
from thermostand.recording.format.layout import FRAMES, TELEMETRY, make_segment_metadata
from thermostand.recording.format.records import read_head
from thermostand.recording.reading.scan import Severity, verify
from thermostand.recording.reading.session import Session
from thermostand.recording.repair.salvage import format_salvaged, salvage_session

TRIALS = [15, mark_nightly(1000)]
"""Places at which a file is damaged, by day and by night."""
SERIES = [TELEMETRY, FRAMES]


@pytest.mark.parametrize("trials", TRIALS)
@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("series", SERIES)
def test_what_is_not_damaged_is_delivered_and_nothing_else(damaged, intact, series, damage, trials):
    rng = random.Random(f"{series} {damage.__name__}")
    for offset in rng.sample(range(len(intact[1][series, "part"].data)), trials):
        folder, path, written = damaged(series, lambda data, at=offset: damage(data, at, rng))
        data = path.read_bytes()
        (done,) = salvage_session(folder.parent)
        delivered = read_segment(done.path) if done.path else []
        assert delivered == written.untouched(data), f"{damage.__name__} at {offset}"
        assert done.messages == len(delivered)
        assert Session.open(folder.parent).incomplete == ()
        assert (done.kept is None) == (done.lost_bytes == 0)
        assert done.kept is None or done.kept.read_bytes() == data


@pytest.mark.parametrize("trials", TRIALS)
@pytest.mark.parametrize("sector_bytes", [512, 4096])
@pytest.mark.parametrize("earlier", [False, True])
def test_a_sector_that_belongs_elsewhere_adds_nothing(damaged, intact, earlier, sector_bytes, trials):
    """It holds whole chunks with right CRCs: of this segment, or of a minute before."""
    rng, part = random.Random(f"{earlier} {sector_bytes}"), intact[1][TELEMETRY, "part"].data
    source = intact[1][TELEMETRY, "finished"].data if earlier else part
    for _ in range(trials):
        begin, to = (rng.randrange(sector_bytes, len(part) - sector_bytes, sector_bytes) for _ in range(2))
        begin = min(begin, to) if earlier else begin
        sector = source[begin : begin + sector_bytes]
        folder, path, written = damaged(
            TELEMETRY, lambda data, at=to, new=sector: data[:at] + new + data[at + len(new) :]
        )
        data = path.read_bytes()
        (done,) = salvage_session(folder.parent)
        assert read_segment(done.path) == written.untouched(data), f"{begin} to {to}"


@pytest.mark.parametrize("trials", TRIALS)
def test_a_sector_of_telemetry_adds_nothing_to_a_segment_of_frames(damaged, intact, trials):
    """Its chunks have right CRCs, and channels of the same numbers."""
    rng, source = random.Random("telemetry in frames"), intact[1][TELEMETRY, "finished"].data
    size = len(intact[1][FRAMES, "part"].data)
    for _ in range(trials):
        begin, to = (rng.randrange(4096, end - 4096, 4096) for end in (len(source), size))
        sector = source[begin : begin + 4096]
        folder, path, written = damaged(FRAMES, lambda data, at=to, new=sector: data[:at] + new + data[at + len(new) :])
        data = path.read_bytes()
        (done,) = salvage_session(folder.parent)
        assert read_segment(done.path) == written.untouched(data), f"{begin} to {to}"
        assert done.kept is not None


@pytest.mark.parametrize("trials", [8, mark_nightly(300)])
@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("series", SERIES)
def test_a_finished_segment_that_is_damaged_is_salvaged_and_kept(damaged, intact, series, damage, trials):
    rng = random.Random(f"finished {series} {damage.__name__}")
    for offset in rng.sample(range(len(intact[1][series, "finished"].data)), trials):
        folder, path, written = damaged(series, lambda data, at=offset: damage(data, at, rng), "finished")
        data = path.read_bytes()
        done = {result.source: result for result in salvage_session(folder.parent)}
        assert (read_segment(path) if path.exists() else []) == written.untouched(data)
        if path in done:
            assert done[path].kept == folder / "0000.mcap.damaged"
            assert done[path].kept.read_bytes() == data


@pytest.mark.parametrize("series", SERIES)
def test_every_stretch_between_several_holes_is_delivered(damaged, series):
    def holes(data):
        for begin in range(len(data) // 10, len(data), len(data) // 5):
            data = hole(begin, begin + 100)(data)
        return data

    folder, path, written = damaged(series, holes)
    data = path.read_bytes()
    (done,) = salvage_session(folder.parent)
    assert read_segment(done.path) == written.untouched(data)
    assert 0 < done.messages < len(written.messages)
    assert "5 damaged places" in done.reason
    assert metadata_of(done.path, "repair")["damaged_places"] == "5"


def test_a_copy_says_from_what_it_was_made_and_reads_like_a_recording(damaged):
    folder, _, _ = damaged(FRAMES, lambda data: data[:-160])
    (done,) = salvage_session(folder.parent)
    assert metadata_of(done.path, "repair") == {
        "source": "0001.mcap.part",
        "reason": done.reason,
        "messages": "46",
        "lost_bytes": "0",
        "damaged_places": "0",
    }
    place = {"series": "frames", "number": "0001", "previous": "0000"}
    assert metadata_of(done.path, "segment").items() > place.items()
    session = Session.open(folder.parent)
    assert (session.metadata, session.attachment("config.yaml")) == (METADATA, ATTACHMENTS["config.yaml"])
    assert session.frame_count == 24 + 23


@pytest.mark.parametrize("series", SERIES)
def test_a_block_that_was_being_written_is_no_loss(damaged, series):
    for change in (lambda data: data[:-60], lambda data: data[:-60] + bytes(60), lambda data: data + bytes(200)):
        folder, _, _ = damaged(series, change)
        (done,) = salvage_session(folder.parent)
        assert (done.lost_bytes, done.kept) == (0, None)
        assert names(folder) == ["0000.mcap", "0001.mcap"]


def test_what_was_wrong_and_what_became_of_it_is_reported(damaged):
    folder, _, _ = damaged(FRAMES, hole(9000, 9100))
    (done,) = salvage_session(folder.parent)
    assert re.match(rf"1 damaged place of {done.lost_bytes} bytes, .* byte \d+$", done.reason)
    text = format_salvaged(done)
    assert f"{done.messages} messages in 0001.mcap, {done.lost_bytes} bytes lost" in text
    folder, _, _ = damaged(FRAMES, lambda data: hole(9000, 9100)(hole(30_000, 30_100)(data)))
    (done,) = salvage_session(folder.parent)
    assert done.reason.startswith(f"2 damaged places of {done.lost_bytes} bytes")
    folder, _, _ = damaged(FRAMES, lambda data: data[:-160])
    (done,) = salvage_session(folder.parent)
    assert re.match(r"a block of \d+ bytes", done.reason)
    assert format_salvaged(done).endswith(f"0001.mcap.part: 46 messages in 0001.mcap ({done.reason})")


def test_a_second_damaged_original_of_a_number_gets_a_name_of_its_own(damaged):
    folder, _, _ = damaged(FRAMES, hole(9000, 9100))
    (folder / "0001.mcap.damaged").write_bytes(b"an older one")
    (done,) = salvage_session(folder.parent)
    assert done.kept == folder / "0001.2.mcap.damaged"
    assert (folder / "0001.mcap.damaged").read_bytes() == b"an older one"
    assert set(Session.open(folder.parent).damaged) == {done.kept, folder / "0001.mcap.damaged"}


@pytest.mark.parametrize("series", SERIES)
def test_a_lost_opening_is_taken_from_the_siblings(damaged, intact, series):
    lost = intact[1][series, "part"].blocks[0].end
    folder, path, written = damaged(series, hole(0, lost))
    data = path.read_bytes()
    (done,) = salvage_session(folder.parent)
    assert read_segment(done.path) == written.untouched(data) == written.messages[len(written.blocks[0].messages) :]
    assert done.path is not None
    assert read_head(done.path).attachments["config.yaml"] == ATTACHMENTS["config.yaml"]


def test_without_a_sibling_the_channels_stay_unknown_and_the_original_is_kept(tmp_path):
    written = write_segment(tmp_path / TELEMETRY, TELEMETRY, range(9))
    part = tmp_path / TELEMETRY / "0000.mcap.part"
    part.write_bytes(hole(written.opening_bytes, written.opening_bytes + 100)(written.data))
    (done,) = salvage_session(tmp_path)
    assert (done.path, done.messages, done.kept) == (None, 0, tmp_path / TELEMETRY / "0000.mcap.damaged")
    assert "no segment describes" in done.reason


def test_without_a_sibling_a_lost_session_is_not_guessed(tmp_path):
    written = write_segment(tmp_path / TELEMETRY, TELEMETRY, range(9))
    (tmp_path / TELEMETRY / "0000.mcap.part").write_bytes(hole(0, written.opening_bytes)(written.data))
    (done,) = salvage_session(tmp_path)
    assert (done.path, done.kept) == (None, tmp_path / TELEMETRY / "0000.mcap.damaged")
    assert "no segment records" in done.reason


def test_the_other_series_tells_the_session(tmp_path):
    written = write_segment(tmp_path / TELEMETRY, TELEMETRY, range(9))
    (tmp_path / TELEMETRY / "0000.mcap.part").write_bytes(hole(0, written.opening_bytes)(written.data))
    write_segment(tmp_path / FRAMES, FRAMES, range(2), finish=True)
    (done,) = salvage_session(tmp_path)
    assert read_segment(done.path) == written.messages
    assert Session.open(tmp_path).metadata == METADATA


@pytest.mark.parametrize(
    "siblings",
    [
        [{"metadata": METADATA | {"session_id": "cycle-2"}}],
        [{"attachments": ATTACHMENTS | {"recipe.yaml": "name: other\n"}}],
        [{}, {"topics": TOPICS[TELEMETRY][::-1]}],
    ],
    ids=["other session", "other attachments", "of several minds"],
)
def test_a_sibling_that_may_not_be_one_is_not_used(tmp_path, siblings):
    folder = tmp_path / TELEMETRY
    for sibling in siblings:
        write_segment(folder, TELEMETRY, range(9), finish=True, **sibling)
    written = write_segment(folder, TELEMETRY, range(20, 29))
    first = written.blocks[0]
    (part,) = folder.glob("*.part")
    part.write_bytes(hole(first.begin, first.end)(written.data))
    (done,) = salvage_session(tmp_path)
    assert (done.path, done.kept) == (None, part.with_suffix(".damaged"))


def test_metadata_is_voted_on(damaged):
    folder, _, written = damaged(TELEMETRY, lambda data: data.replace("Zoë".encode(), b"Zof!", 1))
    assert written.data.count("Zoë".encode()) == 1
    (done,) = salvage_session(folder.parent)
    assert metadata_of(done.path, "session") == METADATA
    assert read_segment(done.path) == written.messages


@pytest.mark.parametrize("series", SERIES)
@pytest.mark.parametrize("record", ["session", "segment"])
def test_a_flipped_letter_in_the_metadata_of_a_finished_segment_is_repaired(damaged, series, record):
    crc = make_segment_metadata(series, 0, METADATA)["session_crc32"].encode()
    damage = {"session": (b"cycle-1", b"cycle-3"), "segment": (crc, crc[:-1] + b"g")}[record]
    folder, path, written = damaged(series, lambda data: data.replace(*damage, 1), "finished")
    salvaged = {done.source: done for done in salvage_session(folder.parent)}
    done = salvaged[path]
    assert (done.path, done.kept, done.lost_bytes) == (path, folder / "0000.mcap.damaged", 0)
    assert "metadata" in done.reason
    assert "CRC" in done.reason
    assert read_segment(path) == written.messages
    assert Session.open(folder.parent).metadata == METADATA
    errors = [finding.where for finding in verify(folder.parent).findings if finding.severity is Severity.ERROR]
    assert not any(errors)  # "": the session lacks frames


def test_metadata_with_the_zeros_of_a_lost_block_is_no_metadata(tmp_path):
    written = write_segment(tmp_path / TELEMETRY, TELEMETRY, range(3))
    write_segment(tmp_path / FRAMES, FRAMES, range(3))
    name = written.data.index("Zoë".encode())
    (tmp_path / TELEMETRY / "0000.mcap.part").write_bytes(hole(name, name + 2)(written.data))
    done, _ = salvage_session(tmp_path)
    assert metadata_of(done.path, "session") == METADATA
    assert read_segment(done.path) == written.messages
