"""Markers found piece by piece: by any process, the same bits; a killed worker loses nothing; nothing is found
twice."""

import multiprocessing
import os
import pickle
import select
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from itertools import islice
from pathlib import Path

import numpy as np
import psutil
import pytest

from thermostand.compensation.finding.finder import Finder, finder, load_markers, save_markers
from thermostand.compensation.finding.piece import (
    FoundMarkers,
    Piece,
    concatenate_markers,
    find_markers,
    split_into_pieces,
)
from thermostand.compensation.finding.workers import find_in_turn, find_to_file, make_cluster_work, make_process_work
from thermostand.compensation.observations import read_session_target
from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.markers.detection import detect
from thermostand.markers.noise import Noise
from thermostand.recording.format.mcap_bytes import RECORD
from thermostand.recording.format.records import list_frame_places
from thermostand.recording.reading.session import Session

from .conftest import TARGET_YAML, Recorded, record

CRC_AT = 24  # in a chunk's record, behind two instants and a size
HEAD_BYTES = 64


@pytest.fixture(scope="module")
def pieces(recorded: Recorded) -> list[Piece]:
    session = Session.open(recorded.path)
    return split_into_pieces(session, read_session_target(session), frames_per_piece=5)


@pytest.fixture(scope="module")
def serial(pieces: list[Piece]) -> list[FoundMarkers]:
    return [found for _, found in find_in_turn(pieces)]


def assert_same(one: FoundMarkers, other: FoundMarkers) -> None:
    for field in fields(FoundMarkers):
        here, second = getattr(one, field.name), getattr(other, field.name)
        assert (here.dtype, here.shape, here.tobytes()) == (second.dtype, second.shape, second.tobytes()), field.name


def assert_all_same(found: dict[int, FoundMarkers], serial: list[FoundMarkers]) -> None:
    assert sorted(found) == list(range(len(serial)))
    for index, expected in enumerate(serial):
        assert_same(found[index], expected)


def test_the_pieces_of_a_session_are_all_its_frames_once_and_in_order(recorded: Recorded, pieces: list[Piece]):
    session = Session.open(recorded.path)
    assert [piece.frames for piece in pieces] == [5, 5, 5, session.frame_count - 15]
    found = concatenate_markers([find_markers(piece) for piece in reversed(pieces)])
    assert np.array_equal(found.time_ns, session.frame_times_ns)
    assert np.array_equal(found.block, [frame.block_id & 0xFFFFFFFF for frame in session.frames()])


def test_what_is_found_is_near_the_truth_and_a_dark_frame_has_its_reason(recorded: Recorded, pieces: list[Piece]):
    found = concatenate_markers([find_markers(piece) for piece in pieces])
    (dark,) = np.flatnonzero(found.reason != "")
    assert "found 0 of 54" in found.reason[dark]
    seen = found.flags == 0
    assert not seen[dark].any()
    assert seen.mean() > 0.9
    assert np.abs((found.centres_px - recorded.true_px)[seen]).max() < 0.1


@pytest.mark.parametrize("bits", [8, 12])
async def test_frames_decoded_in_part_give_what_whole_images_give(
    recorded: Recorded, pieces: list[Piece], bits: int, tmp_path: Path
):
    """Those of more than 8 bit are decoded whole."""
    session, piece = Session.open(recorded.path), pieces[0]
    if bits > 8:
        await record(tmp_path / "deep", {"target.yaml": TARGET_YAML}, frames=3, bits=bits)
        session = Session.open(tmp_path / "deep")
        (piece,) = split_into_pieces(session, read_session_target(session), frames_per_piece=5)
    found, previous = find_markers(piece), None
    for number, frame in enumerate(islice(session.frames(), len(found.centres_px))):
        assert frame.image.itemsize == -(-bits // 8)
        previous = detect(frame.image, piece.target, previous, piece.noise)
        np.testing.assert_array_equal(found.centres_px[number], previous.centres_px)
        np.testing.assert_array_equal(found.covariance_px2[number], previous.covariance_px2)


def test_processes_find_the_same_bits(pieces: list[Piece], serial: list[FoundMarkers]):
    assert_all_same(dict(make_process_work(2)(pieces)), serial)


def test_a_killed_process_loses_nothing(pieces: list[Piece], serial: list[FoundMarkers]):
    found: dict[int, FoundMarkers] = {}
    for index, markers in make_process_work(2)(pieces):
        if not found:
            for child in multiprocessing.active_children():
                child.kill()
        assert index not in found
        found[index] = markers
    assert_all_same(found, serial)


def test_what_a_process_answers_fits_into_one_write_of_a_pipe(
    pieces: list[Piece], serial: list[FoundMarkers], tmp_path: Path
):
    """Else the pool of one that is killed in the middle of its answer would wait for the rest for ever."""
    answer = find_to_file(pieces[0], str(tmp_path))
    assert len(pickle.dumps(answer)) < select.PIPE_BUF / 4
    assert_same(pickle.loads(Path(answer).read_bytes()), serial[0])


OWNER = """if True:
    import os, time
    from thermostand.compensation.finding.workers import open_pool
    if __name__ == "__main__":
        with open_pool(1) as processes:
            print(processes.submit(os.getpid).result(), flush=True)
            time.sleep(60)
"""


def test_a_process_ends_with_the_command_that_was_killed(tmp_path: Path):
    (tmp_path / "owner.py").write_text(OWNER)
    owner = subprocess.Popen([sys.executable, tmp_path / "owner.py"], stdout=subprocess.PIPE, text=True)
    assert owner.stdout is not None
    with owner.stdout:
        worker = os.pidfd_open(int(owner.stdout.readline()))
    owner.kill()
    owner.wait()
    has_ended, *_ = select.select([worker], [], [], 10.0)
    os.close(worker)
    assert has_ended


class Poison(Piece):
    """Kills the process that receives it."""

    def __reduce__(self):
        return os._exit, (1,)


def test_a_piece_that_kills_its_workers_ends_with_a_sentence(pieces: list[Piece]):
    poison = Poison(*(getattr(pieces[0], field.name) for field in fields(Piece)))
    with pytest.raises(SessionError, match=r"0000\.mcap: the processes .* are killed each time; .* fewer --workers"):
        list(make_process_work(1)([poison]))


def test_a_segment_that_cannot_be_read_ends_the_work_with_its_sentence(pieces: list[Piece], tmp_path: Path):
    lost = replace(pieces[0], segment=tmp_path / "lost.mcap")
    with pytest.raises(SessionError, match=r"lost\.mcap"):
        list(make_process_work(2)([lost, *pieces]))


def test_a_cluster_finds_the_same_bits_also_when_a_worker_is_killed(pieces: list[Piece], serial: list[FoundMarkers]):
    distributed = pytest.importorskip("distributed")
    dask = pytest.importorskip("dask")
    with (
        dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0", host="127.0.0.1"
        ) as here,
    ):
        found: dict[int, FoundMarkers] = {}
        for index, markers in make_cluster_work(here.scheduler_address)(pieces):
            if not found:
                psutil.Process(here.workers[0].pid).kill()
            found[index] = markers
        assert_all_same(found, serial)


def test_a_cluster_that_does_not_answer_is_named(pieces: list[Piece]):
    with pytest.raises(ConfigError, match=r"--cluster 127\.0\.0\.1:9: no Dask scheduler"):
        list(make_cluster_work("127.0.0.1:9", wait_s=0.2)(pieces))


def nobody(pieces: Sequence[Piece]) -> Iterator[tuple[int, FoundMarkers]]:
    if pieces:
        raise AssertionError(f"{len(pieces)} pieces are not kept")
    yield from ()


def test_what_was_found_is_kept_also_for_a_copy_elsewhere(
    recorded: Recorded, pieces: list[Piece], serial: list[FoundMarkers], tmp_path: Path
):
    reported: list[int] = []
    first = Finder(find_in_turn, tmp_path / "kept")(pieces, reported.append)
    assert reported == [0, 5, 10, 15, sum(piece.frames for piece in pieces)]
    shutil.copytree(recorded.path, tmp_path / "copy")
    session = Session.open(tmp_path / "copy")
    copies = split_into_pieces(session, read_session_target(session), frames_per_piece=5)
    again = Finder(nobody, tmp_path / "kept")(copies, reported.append)
    for one, other, expected in zip(first, again, serial, strict=True):
        assert_same(one, expected)
        assert_same(other, expected)


def test_another_content_target_noise_or_range_is_found_again(pieces: list[Piece], tmp_path: Path):
    Finder(find_in_turn, tmp_path / "kept")(pieces[:1], lambda done: None)
    changed = tmp_path / "changed.mcap"
    content = bytearray(pieces[0].segment.read_bytes())
    content[list_frame_places(pieces[0].segment)[2].chunk.offset + RECORD.size + CRC_AT] ^= 1
    changed.write_bytes(content)
    others = [
        replace(pieces[0], segment=changed),
        replace(pieces[0], target=pieces[0].target.model_copy(update={"pitch_mm": 31.0})),
        replace(pieces[0], noise=Noise()),
        pieces[1],
    ]
    for other in others:
        with pytest.raises(AssertionError, match="1 pieces are not kept"):
            Finder(nobody, tmp_path / "kept")([other], lambda done: None)
    Finder(nobody, tmp_path / "kept")(pieces[:1], lambda done: None)


def test_frames_whose_markers_are_kept_are_not_read_again(
    pieces: list[Piece], serial: list[FoundMarkers], tmp_path: Path
):
    pieces = [piece for piece in pieces if piece.segment == pieces[0].segment]
    Finder(find_in_turn, tmp_path / "kept")(pieces, lambda done: None)
    content = bytearray(pieces[0].segment.read_bytes())
    for place in list_frame_places(pieces[0].segment):
        begin, end = place.chunk.offset + HEAD_BYTES, place.chunk.offset + place.chunk.length
        content[begin:end] = bytes(end - begin)
    emptied = tmp_path / "emptied.mcap"
    emptied.write_bytes(content)
    again = Finder(nobody, tmp_path / "kept")([replace(piece, segment=emptied) for piece in pieces], lambda done: None)
    for found, expected in zip(again, serial, strict=False):
        assert_same(found, expected)


def test_what_is_kept_but_damaged_is_found_again(pieces: list[Piece], serial: list[FoundMarkers], tmp_path: Path):
    Finder(find_in_turn, tmp_path)(pieces[:1], lambda done: None)
    (file,) = tmp_path.iterdir()
    whole = file.read_bytes()
    for damaged in (b"", whole[: len(whole) // 2], b"no archive", whole.replace(b"flags", b"flogs")):
        file.write_bytes(damaged)
        (found,) = Finder(find_in_turn, tmp_path)(pieces[:1], lambda done: None)
        assert_same(found, serial[0])
        assert file.read_bytes() == whole


def test_a_place_that_cannot_be_written_keeps_nothing_and_stops_nobody(
    pieces: list[Piece], serial: list[FoundMarkers], tmp_path: Path
):
    (tmp_path / "file").write_text("")
    save_markers(tmp_path / "file", "key", serial[0])
    assert load_markers(tmp_path / "file", "key") is None
    (found,) = Finder(find_in_turn, tmp_path / "file" / "below")(pieces[:1], lambda done: None)
    assert_same(found, serial[0])


def test_workers_that_cannot_be_are_refused():
    with pytest.raises(ConfigError, match="--workers is 1 or more, not 0"):
        finder(workers=0)
    with pytest.raises(ConfigError, match="exclude each other"):
        finder(workers=2, cluster="127.0.0.1:8786")
