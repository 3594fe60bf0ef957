"""What it costs to have a 5 MP frame safely on the disk: the work of the recorder's frame lane, frame by frame.

Ours: encode the message, commit it to the frames series (pwrite, fdatasync). Peers in the same directory: for PNG,
OpenCV with its default parameters and the same two calls; for raw, the two calls alone with bytes of the same length.
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
from thermostand.drivers.sim.physics.plant import Plant, PlantSpec
from thermostand.drivers.sim.physics.scene import Scene, SceneSpec
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.readings import Frame
from thermostand.recording.format.images import CAMERA_IMAGE, IMAGE_CLASS, ImageEncoding, encode_image
from thermostand.recording.writing.segment import Record, SeriesForm, Topic
from thermostand.recording.writing.series import Series

ROUNDS = 15
FRAMES = 4  # in one measurement
START_NS = 1_767_290_400 * NS_PER_S


def figures(directory: Path) -> list[Figure]:
    """ms per PNG frame and its size, and MB/s of raw frames."""
    image = Scene(SceneSpec(), 1).render(Plant(PlantSpec(), START_NS).optics(START_NS), START_NS, 0.1, 0.0, 1.0)
    return [*_png(directory, image), _raw(directory, image)]


def _png(directory: Path, image: NDArray[np.uint8]) -> list[Figure]:
    progress("recorder, PNG frames")
    with _series(directory, "png") as series, _bare_file(directory / "bare-png") as file:
        own, other = in_turns(
            lambda: 1e3 * _commit_s(series, "png", image),
            lambda: 1e3 * _write_s(file, lambda: cv2.imencode(".png", image)[1].tobytes()),
            ROUNDS,
        )
    sizes_MB = [len(data) / 1e6 for data in (encode_image(_frame(image, 0), "png"), cv2.imencode(".png", image)[1])]
    return [
        at_most(
            100,
            side_by_side("recorder, 5 MP PNG on disk", "ms/frame", "cv2 default PNG, pwrite, fdatasync", own, other),
        ),
        side_by_side("recorder, size of a PNG frame", "MB", "cv2 default PNG", sizes_MB[:1], sizes_MB[1:]),
    ]


def _raw(directory: Path, image: NDArray[np.uint8]) -> Figure:
    progress("recorder, raw frames")
    data = image.tobytes()
    size_MB = len(data) / 1e6
    with _series(directory, "raw") as series, _bare_file(directory / "bare-raw") as file:
        own, other = in_turns(
            lambda: size_MB / _commit_s(series, "raw", image), lambda: size_MB / _write_s(file, lambda: data), ROUNDS
        )
    figure = side_by_side("recorder, 5 MP raw on disk", "MB/s", "bare pwrite, fdatasync", own, other)
    return ratio_at_least(0.9, figure)


def _frame(image: NDArray[np.uint8], number: int) -> Frame:
    time_ns = START_NS + number
    return Frame("camera.image", image, time_ns, 0.1, 0.0, 40.0, number, time_ns)


def _commit_s(series: Series, encoding: ImageEncoding, image: NDArray[np.uint8]) -> float:
    """Seconds per frame."""
    begin_s = time.perf_counter()
    for number in range(FRAMES):
        frame = _frame(image, number)
        series.commit([Record(CAMERA_IMAGE, frame.time_ns, encode_image(frame, encoding), number)], frame.time_ns)
    return (time.perf_counter() - begin_s) / FRAMES


def _write_s(file: int, encode: Callable[[], bytes]) -> float:
    """Seconds per frame."""
    begin_s = time.perf_counter()
    for _ in range(FRAMES):
        os.pwrite(file, encode(), os.fstat(file).st_size)
        os.fdatasync(file)
    return (time.perf_counter() - begin_s) / FRAMES


@contextmanager
def _series(directory: Path, encoding: ImageEncoding) -> Generator[Series]:
    """A frames series as the recorder makes it, in one segment."""
    folder = directory / f"frames-{encoding}"
    folder.mkdir()
    topic = Topic(CAMERA_IMAGE, IMAGE_CLASS[encoding])
    series = Series(folder, SeriesForm("frames", (topic,), CompressionType.NONE, {}, {}, 1 << 40, 1 << 60))
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
