"""What it costs to have a 5 MP frame safely on the disk: the work of the recorder's frame lane, frame by frame.

Ours: encode the messages, commit them to the frames series (pwrite, fdatasync). Peers in the same directory: for
compressed frames OpenCV's PNG with its default parameters and the same two calls; for raw, the two calls alone with
bytes of the same length.
Another disk is measured with TMPDIR=DIRECTORY.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from mcap.writer import CompressionType
from numpy.typing import NDArray

from tests.bench.figures import Figure, at_most, in_turns, progress, ratio_at_least, side_by_side
from tests.recording.stored import CAMERA_TOPICS, stored
from thermostand.drivers.sim.physics.plant import Plant, PlantSpec
from thermostand.drivers.sim.physics.scene import SceneSpec, SimulatedScene
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.readings import Frame
from thermostand.recording.format.images import ZSTD_LEVEL, FrameEncoding
from thermostand.recording.writing.segment import SeriesForm
from thermostand.recording.writing.series import Series

ROUNDS = 15
FRAMES = 4  # in one measurement
START_NS = 1_767_290_400 * NS_PER_S


def figures(directory: Path) -> list[Figure]:
    """ms per compressed frame and its size, and MB/s of raw frames."""
    image = SimulatedScene(SceneSpec(), 1).render(
        Plant(PlantSpec(), START_NS).optics(START_NS), START_NS, 0.1, 0.0, 1.0
    )
    return [*_zstd(directory, image), _raw(directory, image)]


def _zstd(directory: Path, image: NDArray[np.uint8]) -> list[Figure]:
    progress("recorder, compressed frames")
    with _series(directory, "zstd") as series, _bare_file(directory / "bare-png") as file:
        own, other = in_turns(
            lambda: 1e3 * _commit_s(series, image),
            lambda: 1e3 * _write_s(file, lambda: cv2.imencode(".png", image)[1].tobytes()),
            ROUNDS,
        )
        own_MB = _size_MB(series, image)
    sizes_MB = own_MB, len(cv2.imencode(".png", image)[1]) / 1e6
    return [
        at_most(
            100,
            side_by_side("recorder, 5 MP on disk", "ms/frame", "cv2 default PNG, pwrite, fdatasync", own, other),
        ),
        side_by_side("recorder, size of a frame", "MB", "cv2 default PNG", sizes_MB[:1], sizes_MB[1:]),
    ]


def _raw(directory: Path, image: NDArray[np.uint8]) -> Figure:
    progress("recorder, raw frames")
    data = image.tobytes()
    size_MB = len(data) / 1e6
    with _series(directory, "raw") as series, _bare_file(directory / "bare-raw") as file:
        own, other = in_turns(
            lambda: size_MB / _commit_s(series, image), lambda: size_MB / _write_s(file, lambda: data), ROUNDS
        )
    figure = side_by_side("recorder, 5 MP raw on disk", "MB/s", "bare pwrite, fdatasync", own, other)
    return ratio_at_least(0.9, figure)


def _frame(image: NDArray[np.uint8], number: int) -> Frame:
    time_ns = START_NS + number
    return Frame("camera.image", image, time_ns, 0.1, 0.0, 40.0, number, time_ns)


def _commit_s(series: Series, image: NDArray[np.uint8]) -> float:
    """Seconds per frame."""
    begin_s = time.perf_counter()
    for number in range(FRAMES):
        frame = _frame(image, number)
        series.commit(stored(frame), frame.time_ns)
    return (time.perf_counter() - begin_s) / FRAMES


def _size_MB(series: Series, image: NDArray[np.uint8]) -> float:
    """Of one frame, as the file grows by it."""
    segment, frame = series.open(0), _frame(image, 0)
    before = segment.committed_bytes
    series.commit(stored(frame), frame.time_ns)
    return (segment.committed_bytes - before) / 1e6


def _write_s(file: int, encode: Callable[[], bytes]) -> float:
    """Seconds per frame."""
    begin_s = time.perf_counter()
    for _ in range(FRAMES):
        os.pwrite(file, encode(), os.fstat(file).st_size)
        os.fdatasync(file)
    return (time.perf_counter() - begin_s) / FRAMES


@contextmanager
def _series(directory: Path, encoding: FrameEncoding) -> Generator[Series]:
    """A frames series as the recorder makes it, in one segment."""
    folder = directory / f"frames-{encoding}"
    folder.mkdir()
    compression = CompressionType.NONE if encoding == "raw" else CompressionType.ZSTD
    form = SeriesForm("frames", CAMERA_TOPICS, compression, {}, {}, 1 << 40, 1 << 60, level=ZSTD_LEVEL)
    series = Series(folder, form)
    try:
        yield series
    finally:
        series.finish()


@contextmanager
def _bare_file(path: Path) -> Generator[int]:
    file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
    try:
        yield file
    finally:
        os.close(file)
        path.unlink()
