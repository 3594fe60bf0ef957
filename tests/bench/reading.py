"""What it costs to look into a session: one frame, or all temperatures, of 1 GB, of 5 GB and of a session.

The sessions are written by the recorder's own series: raw frames of 5 MP at 2 per second in segments of 1 GB, telemetry
of seven devices each second; the session is 16 h of telemetry alone. The one of 1 GB is the first segment of the other.
The peer does the same with mcap's own reader, CRCs checked as ours are. All files are in the page cache.
"""

from __future__ import annotations

import os
import random
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.reader import make_reader
from mcap.writer import CompressionType
from numpy.typing import NDArray

from tests.bench.figures import (
    Figure,
    compare,
    make_absolute,
    measure_in_turns,
    measure_milliseconds,
    report_progress,
    set_upper_goal,
)
from tests.recording.device_declarations import PLACES
from tests.recording.frame_records import CAMERA_TOPICS, make_frame_records
from tests.recording.recordings import DEVICES
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.items import Batch
from thermostand.foundation.readings import Frame, Reading
from thermostand.recording.format import messages
from thermostand.recording.format.batches import make_batch_schema
from thermostand.recording.format.layout import FORMAT, FRAMES, TELEMETRY
from thermostand.recording.reading.session import Session
from thermostand.recording.writing.segment import SeriesSpec, Topic
from thermostand.recording.writing.series import Series
from thermostand.recording.writing.session_spec import list_telemetry_topics
from thermostand.recording.writing.telemetry import TelemetryEncoder

ROUNDS = 50
START_NS = 1_767_290_400 * NS_PER_S
FRAME_PERIOD_NS = NS_PER_S // 2
HEIGHT_px, WIDTH_px = 2048, 2448
FRAMES_PER_SEGMENT = 200  # 1.0 GB
SEGMENTS = 5
SESSION_s = 16 * 3600
TEMPERATURES = tuple(f"thermometers.{place}" for place in PLACES)
TEMPERATURE_FIELDS = tuple(f"{place}_degC" for place in PLACES)
METADATA = {"format": str(FORMAT), "session_id": "bench"}
ATTACHMENTS = {"config.yaml": "a: 1\n" * 400}


def figures(directory: Path) -> list[Figure]:
    """ms for a random frame and for all temperatures, each beside mcap's reader, and how both grow with the size."""
    small, large, long = (directory / name for name in ("1GB", "5GB", "cycle"))
    try:
        _write_sessions(small, large, long)
        return [*_frame_figures(small, large), *_temperature_figures(small, large, long)]
    finally:
        for session in (small, large, long):
            shutil.rmtree(session, ignore_errors=True)


def _write_sessions(small: Path, large: Path, long: Path) -> None:
    report_progress("reading, 5 GB of frames are written")
    _write_frames(large)
    write_telemetry(large, SEGMENTS * FRAMES_PER_SEGMENT // 2)
    (small / FRAMES).mkdir(parents=True)
    os.link(large / FRAMES / "0000.mcap", small / FRAMES / "0000.mcap")
    write_telemetry(small, FRAMES_PER_SEGMENT // 2)
    report_progress("reading, 16 h of telemetry are written")
    write_telemetry(long, SESSION_s)


def _series(folder: Path, topics: tuple[Topic, ...], compression: CompressionType, segment_bytes: int) -> Series:
    folder.mkdir(parents=True)
    form = SeriesSpec(folder.name, topics, compression, METADATA, ATTACHMENTS, segment_bytes, 600 * NS_PER_S)
    return Series(folder, form)


def _write_frames(session: Path) -> None:
    size = FRAMES_PER_SEGMENT * HEIGHT_px * WIDTH_px
    series = _series(session / FRAMES, CAMERA_TOPICS, CompressionType.NONE, size)
    noise = np.random.default_rng(1).integers(0, 256, (HEIGHT_px + 100, WIDTH_px), np.uint8)
    for number in range(SEGMENTS * FRAMES_PER_SEGMENT):
        frame = _frame(number, noise[number % 100 :][:HEIGHT_px])
        series.commit(make_frame_records(frame), frame.time_ns)
    series.finish()


def _frame(number: int, image: NDArray[np.uint8]) -> Frame:
    time_ns = START_NS + number * FRAME_PERIOD_NS
    return Frame("camera.image", image, time_ns, 0.1, 0.0, 40.0, number, time_ns)


def write_telemetry(session: Path, duration_s: int) -> None:
    """Seven devices, each read every second."""
    encoder = TelemetryEncoder(DEVICES)
    series = _series(session / TELEMETRY, list_telemetry_topics(DEVICES), CompressionType.ZSTD, 1_000_000_000)
    image = np.zeros((1, 1), np.uint8)
    for begin in range(0, duration_s, 60):
        records = [
            record
            for second in range(begin, min(begin + 60, duration_s))
            for item in (*_batches(second), _frame(2 * second, image), _frame(2 * second + 1, image))
            for record in encoder.encode(item)
        ]
        series.commit(records, START_NS + begin * NS_PER_S)
    series.finish()


def _batches(second: int) -> Iterator[Batch]:
    for index, (device, recorded) in enumerate(DEVICES.items()):
        time_ns = START_NS + second * NS_PER_S + index
        values = random.Random(second * len(DEVICES) + index)
        readings = [
            Reading(f"{device}.{channel.name}", round(values.gauss(20, 1), 2), channel.unit, time_ns)
            for channel in recorded.channels
        ]
        yield Batch(device, time_ns, tuple(readings))


def _frame_figures(small: Path, large: Path) -> list[Figure]:
    report_progress("reading, random frames")
    with ExitStack() as files:
        readers = [make_reader(files.enter_context(path.open("rb")), validate_crcs=True) for path in _frames(large)]
        opened = Session.open(large)
        fresh = {path: _random(_fresh_frame, path) for path in (small, large)}
        own, other = measure_in_turns(fresh[large], _random(_peer_frame, large), ROUNDS)
        own_open, other_open = measure_in_turns(
            lambda: measure_milliseconds(lambda: opened.frame(_numbers.randrange(opened.frame_count))),
            lambda: measure_milliseconds(lambda: _frame_of(readers, _numbers.randrange(opened.frame_count))),
            ROUNDS,
        )
        own_read, bare_read = measure_in_turns(
            lambda: measure_milliseconds(lambda: opened.frame(_numbers.randrange(opened.frame_count))),
            _random(_bare_read, large),
            ROUNDS,
        )
        in_large, in_small = measure_in_turns(fresh[large], fresh[small], ROUNDS)
    return [
        set_upper_goal(
            10, compare("reading, 5 GB: open, random 5 MP frame", "ms", "mcap make_reader, CRCs", own, other)
        ),
        set_upper_goal(
            10,
            compare("reading, 5 GB open: random 5 MP frame", "ms", "the same, readers open", own_open, other_open),
        ),
        compare("reading, 5 GB open: random 5 MP frame", "ms", "bare pread of the bytes", own_read, bare_read),
        compare("reading, 5 GB: open, random 5 MP frame", "ms", "ours, 1 GB", in_large, in_small),
        compare(
            "reading, 1 GB: open, table of 200 frames",
            "ms",
            "mcap make_reader, CRCs",
            *measure_in_turns(_timed(_own_table, small), _timed(_peer_table, small), 5),
        ),
    ]


_numbers = random.Random(7)


def _random(read: Callable[[Path, int], object], session: Path) -> Callable[[], float]:
    """A measurement: `read` one frame of the session at random, ms."""
    count = FRAMES_PER_SEGMENT * len(_frames(session))
    return lambda: measure_milliseconds(lambda: read(session, _numbers.randrange(count)))


def _frames(session: Path) -> list[Path]:
    return sorted((session / FRAMES).iterdir())


def _fresh_frame(session: Path, number: int) -> object:
    return Session.open(session).frame(number)


def _peer_frame(session: Path, number: int) -> object:
    """The segment is known to the peer, the meaning of the frame's description spared."""
    with _frames(session)[number // FRAMES_PER_SEGMENT].open("rb") as file:
        return _frame_of([make_reader(file, validate_crcs=True)], number)


def _bare_read(session: Path, number: int) -> bytes:
    """As many bytes as the frame has, from about where it is."""
    file = os.open(_frames(session)[number // FRAMES_PER_SEGMENT], os.O_RDONLY)
    try:
        return os.pread(file, HEIGHT_px * WIDTH_px, number % FRAMES_PER_SEGMENT * HEIGHT_px * WIDTH_px)
    finally:
        os.close(file)


def _frame_of(readers: list[Any], number: int) -> NDArray[np.uint8]:
    time_ns = START_NS + number * FRAME_PERIOD_NS
    reader = readers[number // FRAMES_PER_SEGMENT % len(readers)]
    ((_, _, message),) = reader.iter_messages(["/camera/image"], starting_at=time_ns, ending_before=time_ns + 1)
    return np.frombuffer(RawImage.FromString(message.data).data, np.uint8).reshape(HEIGHT_px, WIDTH_px)


def _own_table(session: Path) -> object:
    return Session.open(session).frame_metas()


def _peer_table(session: Path) -> object:
    found: list[Any] = []
    for path in _frames(session):
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            found += [message.data for _, _, message in reader.iter_messages(["/camera/meta"])]
    return list(map(messages.decode_frame_meta, found))


def _temperature_figures(small: Path, large: Path, long: Path) -> list[Figure]:
    report_progress("reading, temperatures")
    found = [
        compare(
            f"reading, {what}: open, all temperatures",
            "ms",
            "mcap make_reader, CRCs, protobuf",
            *measure_in_turns(_timed(_own_temperatures, path), _timed(_peer_temperatures, path), rounds),
        )
        for what, path, rounds in (("5 GB", large, 20), ("16 h", long, 5))
    ]
    found[0] = set_upper_goal(100, found[0])
    return [*found, make_absolute("reading, 5 GB: open", "ms", [_timed(Session.open, large)() for _ in range(ROUNDS)])]


def _timed(read: Callable[[Path], object], session: Path) -> Callable[[], float]:
    return lambda: measure_milliseconds(lambda: read(session))


def _own_temperatures(session: Path) -> list[NDArray[np.float64]]:
    opened = Session.open(session)
    return [opened.readings(channel)[1] for channel in TEMPERATURES]


def _peer_temperatures(session: Path) -> list[NDArray[np.float64]]:
    rows = [row for path in sorted((session / TELEMETRY).iterdir()) for row in _peer_rows(path)]
    return list(np.array(rows).T)


def _peer_rows(path: Path) -> Iterable[list[float]]:
    form = make_batch_schema("thermometers", DEVICES["thermometers"])
    topic, parse = form.topic, form.message.FromString
    with path.open("rb") as file:
        for _, _, message in make_reader(file, validate_crcs=True).iter_messages([topic]):
            decoded = parse(message.data)
            yield [getattr(decoded, name) for name in TEMPERATURE_FIELDS]
