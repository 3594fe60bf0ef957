"""A thousand broken sessions, by night ten: each read is what was recorded, or a SessionError in one sentence that
names it."""

import ctypes
import os
import resource
import shutil
import signal
from collections import Counter
from contextlib import contextmanager, suppress
from random import Random

import numpy as np
import pytest
from mcap.writer import CompressionType

from tests.recording.device_declarations import declare_devices
from tests.recording.frame_records import CAMERA_TOPICS, make_frame_records
from tests.recording.segment_fuzzer import (
    mutate_bytes,
    mutate_field,
    mutate_inside,
    mutate_order,
    put_together,
    take_apart,
)
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import Batch, Event, StepMark, StepState
from thermostand.foundation.readings import Frame, Reading
from thermostand.recording.format.layout import FORMAT, FRAMES, TELEMETRY
from thermostand.recording.format.records import list_frame_places, read_frame, read_telemetry_messages
from thermostand.recording.reading.overview import summarise_session
from thermostand.recording.reading.scan import verify
from thermostand.recording.reading.session import Session
from thermostand.recording.repair.salvage import salvage_session
from thermostand.recording.writing.segment import SeriesSpec
from thermostand.recording.writing.series import Series
from thermostand.recording.writing.session_spec import list_telemetry_topics
from thermostand.recording.writing.telemetry import TelemetryEncoder

START_NS = 1_767_290_400 * NS_PER_S
METADATA = {"format": str(FORMAT), "session_id": "cycle-1", "operator": "J. Krukowski"}
ATTACHMENTS = {"config.yaml": "a: 1\n"}
ENCODER = TelemetryEncoder(declare_devices({"camera": "camera"}))
SEGMENTS = (f"{TELEMETRY}/0000.mcap", f"{FRAMES}/0000.mcap")
LIBC, MMAP_THRESHOLD = ctypes.CDLL(None), -3  # of mallopt(3)
MEMORY_BYTES = 192 << 20  # more than it had; the largest honest need is 64 MiB for a chunk
LIMIT_S = 5.0
ROUNDS = 8
INPUTS = 10_000
SALVAGES = 1000
VERIFICATIONS = 1000
# Seed, and what part of a round of the session is tried.
PARTS = [(0, 10), *(pytest.param(seed, 1, marks=pytest.mark.nightly) for seed in range(ROUNDS // 4))]


class TooSlow(BaseException):
    """No Exception, so that nothing takes it for damage."""


def items(second):
    time_ns = START_NS + second * NS_PER_S
    remark = "slow" if second % 2 else ""
    yield Batch("camera", time_ns, (Reading("camera.temperature", 40 + second / 8, "degC", time_ns, reason=remark),))
    yield frame(second)
    yield StepMark(time_ns, f"soak-{second}", second, "soak", StepState.DONE, {"soak_s": 2700.0})
    yield Event(time_ns, "info", "note", f"second {second}")


def frame(second):
    image = np.random.default_rng(second).integers(0, 255, (6, 8), np.uint8)
    return Frame("camera.image", image, START_NS + second * NS_PER_S + 7, 0.1, 0.0, 41.0, second, 7 * second)


def write_session(directory, encoding):
    """Four seconds in two chunks of telemetry, and four frames."""
    compression = CompressionType.NONE if encoding == "raw" else CompressionType.ZSTD
    images = [make_frame_records(frame(k)) for k in range(4)]
    halves = ([item for k in seconds for item in items(k)] for seconds in ((0, 1), (2, 3)))
    telemetry = [[record for item in half for record in ENCODER.encode(item)] for half in halves]
    write_series(directory / FRAMES, CAMERA_TOPICS, compression, images)
    write_series(
        directory / TELEMETRY,
        list_telemetry_topics(declare_devices({"camera": "camera"})),
        CompressionType.ZSTD,
        telemetry,
    )


def write_series(folder, topics, compression, commits):
    folder.mkdir(parents=True)
    series = Series(folder, SeriesSpec(folder.name, topics, compression, METADATA, ATTACHMENTS, 1 << 40, 1 << 60))
    for records in commits:
        series.commit(records, START_NS)
    series.finish()


@pytest.fixture(scope="module", params=["zstd", "raw"])
def sound(request, tmp_path_factory):
    directory = tmp_path_factory.mktemp("sound") / request.param
    write_session(directory, request.param)
    return directory


def frame_key(got):
    return (*(repr(getattr(got, name)) for name in ("time_ns", "camera_degC", "block_id", "step_id")), *image_key(got))


def image_key(got):
    return got.image.shape, got.image.tobytes()


def item_key(item):
    return frame_key(item) if isinstance(item, Frame) else repr(item)


# What a session can be asked for, each as a sequence in the order it is delivered.
READS = {
    "metadata": lambda session: session.metadata.items(),
    "attachments": lambda session: session.attachments.items(),
    "channels": lambda session: session.channels(),
    "readings": lambda session: [(name, *map(list, session.readings(name))) for name in session.channels()],
    "temperature": lambda session: zip(*session.readings("camera.temperature"), strict=True),
    "steps": lambda session: session.steps(),
    "events": lambda session: session.events(),
    "frame times": lambda session: session.frame_times_ns.tolist(),
    "descriptions": lambda session: session.frame_metas(),
    "frame": lambda session: [frame_key(session.frame(2))],
    "frames": lambda session: map(frame_key, session.frames()),
    "items": lambda session: map(item_key, session.items()),
}


def read_everything(directory, delivered):
    """Fill `delivered` with what each read gives, and return the errors."""
    errors = []
    try:
        session = Session.open(directory)
    except SessionError as error:
        return [error]
    for name, read in READS.items():
        values = delivered[name] = []
        try:
            for value in read(session):
                values.append(repr(value))
        except SessionError as error:
            errors.append(error)
            values.append("refused")
    return errors


@contextmanager
def limits():
    """Little more memory than there is in use, and an alarm for what takes too long."""

    def ring(*_):
        raise TooSlow

    with open("/proc/self/statm") as statm:
        used_bytes = int(statm.read().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    handler = signal.signal(signal.SIGALRM, ring)
    # What is large is asked of the kernel, not taken from what earlier tests have given back.
    LIBC.mallopt(MMAP_THRESHOLD, 128 << 10)
    resource.setrlimit(resource.RLIMIT_AS, (used_bytes + MEMORY_BYTES, before[1]))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, handler)
        resource.setrlimit(resource.RLIMIT_AS, before)
        LIBC.mallopt(MMAP_THRESHOLD, int(os.environ.get("MALLOC_MMAP_THRESHOLD_", 128 << 10)))


def mutants(directory, seed, mutations, count):
    """Yields `count` times after one segment in `directory` was broken, and in the end repairs it."""
    rng = Random(seed)
    originals = {name: (directory / name).read_bytes() for name in SEGMENTS}
    for _ in range(count):
        name = rng.choice(SEGMENTS)
        (directory / name).write_bytes(rng.choice(mutations)(rng, originals[name]))
        signal.setitimer(signal.ITIMER_REAL, LIMIT_S)
        yield
        (directory / name).write_bytes(originals[name])


def check_errors(errors, directory):
    for error in errors:
        text = str(error)
        assert str(directory) in text, text
        assert "\n" not in text
        assert "MemoryError" not in text, "sizes are checked before memory is taken"


@pytest.mark.parametrize(("seed", "part"), PARTS)
def test_damage_is_refused_or_harmless_and_never_wrong_data(sound, tmp_path, seed, part):
    directory = shutil.copytree(sound, tmp_path / "copy")
    expected = {}
    assert read_everything(directory, expected) == []
    refused = 0
    mutations = (mutate_bytes, mutate_bytes, mutate_field, mutate_order)
    count = INPUTS // ROUNDS // part
    with limits():
        for _ in mutants(directory, seed, mutations, count):
            delivered = {}
            errors = read_everything(directory, delivered)
            check_errors(errors, directory)
            refused += bool(errors)
            for name, values in delivered.items():
                if values[-1:] == ["refused"]:
                    assert values[:-1] == expected[name][: len(values) - 1], name
                else:
                    assert values == expected[name], name
    assert refused > count / 2


@pytest.mark.parametrize(("seed", "part"), PARTS)
def test_wrong_content_under_right_crcs_is_data_or_a_sentence(sound, tmp_path, seed, part):
    directory = shutil.copytree(sound, tmp_path / "copy")
    refused = 0
    count = INPUTS // ROUNDS // part
    with limits():
        for _ in mutants(directory, 100 + seed, (mutate_inside,), count):
            errors = read_everything(directory, {})
            check_errors(errors, directory)
            refused += bool(errors)
    assert count / 10 < refused < count


def recorded_messages(directory):
    """Every message of the finished segments, telemetry first, in the order of the files."""
    session = Session.open(directory)
    for path in session.segments:
        if path.parent.name == TELEMETRY:
            yield from read_telemetry_messages(path, lambda channel: True)
        else:
            yield from ((frame.meta, bytes(frame.image)) for frame in map(read_frame, list_frame_places(path)))


@pytest.mark.parametrize(("seed", "part"), PARTS)
def test_what_is_salvaged_was_recorded_and_nothing_else(sound, tmp_path, seed, part):
    expected = Counter(recorded_messages(sound))
    rng = Random(200 + seed)
    mutations = (mutate_bytes, mutate_bytes, mutate_field, mutate_order)
    recovered = 0
    with limits():
        for _ in range(SALVAGES // ROUNDS // part):
            directory = shutil.copytree(sound, tmp_path / "copy")
            path = directory / rng.choice(SEGMENTS)
            path.write_bytes(rng.choice(mutations)(rng, path.read_bytes()))
            if rng.random() < 0.5:
                path = path.rename(path.with_suffix(".mcap.part"))
            signal.setitimer(signal.ITIMER_REAL, LIMIT_S)
            salvage_session(directory)
            with suppress(SessionError):  # when nothing could be recovered of a series
                got = Counter(recorded_messages(directory))
                assert got.keys() <= expected.keys()  # a chunk that stands in the file twice is found twice
                recovered += got.total()
            check_errors(read_everything(directory, {}), directory)
            shutil.rmtree(directory)
    assert recovered > SALVAGES // ROUNDS // part * expected.total() / 2


@pytest.mark.parametrize("part", [10, pytest.param(1, marks=pytest.mark.nightly)])
def test_salvage_of_wrong_content_under_right_crcs_gives_data_or_a_sentence(sound, tmp_path, part):
    rng = Random(300)
    with limits():
        for _ in range(SALVAGES // 4 // part):
            directory = shutil.copytree(sound, tmp_path / "copy")
            path = directory / rng.choice(SEGMENTS)
            path.write_bytes(mutate_inside(rng, path.read_bytes()))
            signal.setitimer(signal.ITIMER_REAL, LIMIT_S)
            try:
                salvage_session(directory)
            except SessionError as error:
                check_errors([error], directory)
            check_errors(read_everything(directory, {}), directory)
            shutil.rmtree(directory)


@pytest.mark.parametrize("part", [10, pytest.param(1, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("mutations", [(mutate_bytes, mutate_field, mutate_order), (mutate_inside,)])
def test_verify_and_overview_answer_whatever_a_segment_holds(sound, tmp_path, mutations, part):
    """Damage is part of their answer, and what verify does not find is harmless."""
    directory = shutil.copytree(sound, tmp_path / "copy")
    expected = {}
    assert read_everything(directory, expected) == []
    found = 0
    with limits():
        for _ in mutants(directory, 400, mutations, VERIFICATIONS // 4 // part):
            summarise_session(directory)
            findings = verify(directory).findings
            found += bool(findings)
            assert not any("\n" in str(finding) for finding in findings)
            if not findings and mutate_inside not in mutations:
                delivered = {}
                assert read_everything(directory, delivered) == []
                assert delivered == expected
    assert found > VERIFICATIONS / 8 / part


def test_the_broken_sessions_begin_with_sound_ones(sound, tmp_path):
    """Taken apart and put together again a segment reads the same: then what is refused is so for its mutation."""
    directory = shutil.copytree(sound, tmp_path / "copy")
    expected, got = {}, {}
    read_everything(sound, expected)
    for name in SEGMENTS:
        data = (directory / name).read_bytes()
        (directory / name).write_bytes(put_together(take_apart(data)))
        assert len(data) < 10_000
    assert read_everything(directory, got) == []
    assert got == expected
    assert len(expected["frames"]) == 4
    assert len(expected["items"]) == 16
