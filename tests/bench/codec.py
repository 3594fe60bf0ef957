"""What a frame costs as a chunk: processor time and size, beside OpenCV's PNG.

The frames are 5 MP of the target in uneven light with Gaussian noise of a known sigma, and one of the simulator's.
Times are of one thread of the processor, so that other programs of the machine count less.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType
from numpy.typing import NDArray

from tests.bench.figures import Figure, absolute, in_turns, processor_ms, progress, side_by_side
from tests.compensation.rendered import Scene, render, shaded_light
from tests.recording.stored import stored
from thermostand.drivers.sim.physics.plant import Plant, PlantSpec
from thermostand.drivers.sim.physics.scene import SceneSpec, SimulatedScene
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.readings import Frame
from thermostand.markers.target import load_target
from thermostand.markers.windows import marker_windows
from thermostand.recording.format.images import ZSTD_LEVEL, ImageArray, MarkerWindows, decode_image
from thermostand.recording.format.mcap_bytes import LENGTH, RECORD, chunk_content
from thermostand.recording.format.records import frame_messages
from thermostand.recording.writing.mcap_writer import McapWriter
from thermostand.recording.writing.segment import CHUNK_BYTES
from thermostand.stand.config.stand_config import packaged

ROUNDS = 11
START_NS = 1_767_290_400 * NS_PER_S

Image = NDArray[np.uint8] | NDArray[np.uint16]
Float = NDArray[np.float64]


def figures(directory: Path) -> list[Figure]:
    """ms and ratios of frames of 8 and 12 bit, and of the windows around the markers."""
    progress("codec, rendering the frames")
    clean = render(Scene(ground_DN=170.0, light=shaded_light))
    simulated = SimulatedScene(SceneSpec(), 1).render(
        Plant(PlantSpec(), START_NS).optics(START_NS), START_NS, 0.1, 0, 1
    )
    with _one_thread():
        return [
            *_costs("8 bit", noisy(clean, 1.5, np.uint8, 1)),
            *_costs("8 bit of the demo", simulated),
            *_costs("12 bit, noise 24 DN", noisy(clean * 16, 24.0, np.uint16, 1)),
            *_roi(clean),
        ]


def noisy(clean_DN: Float, sigma_DN: float, dtype: type[np.uint8] | type[np.uint16], seed: int) -> Image:
    """The clean image with Gaussian noise, rounded; it stays clear of the ends of its range."""
    rng = np.random.default_rng(seed)
    noisy: Any = np.round(clean_DN + rng.normal(0, sigma_DN, clean_DN.shape)).astype(dtype)
    return noisy


def chunk_of(frame: Frame) -> bytes:
    """The frame as the recorder's chunk, with what stands behind it."""
    writer = McapWriter(CompressionType.ZSTD, CHUNK_BYTES, ZSTD_LEVEL)
    writer.take()
    for number, record in enumerate(stored(frame), 1):
        writer.add_message(number, record.time_ns, record.published_ns, record.sequence, record.data)
    writer.end_chunk()
    return b"".join(writer.take())


def image_in(chunk: bytes) -> ImageArray:
    """The image in it, its CRC checked."""
    (length,) = LENGTH.unpack_from(chunk, 1)
    _, data = chunk_content(memoryview(chunk)[RECORD.size : RECORD.size + length])
    return decode_image(frame_messages(data)[1].data)


def _costs(what: str, image: Image) -> list[Figure]:
    progress(f"codec, {what}")
    chunk, (_, png) = chunk_of(_frame(image)), cv2.imencode(".png", image)
    into = in_turns(
        lambda: processor_ms(lambda: chunk_of(_frame(image))),
        lambda: processor_ms(lambda: cv2.imencode(".png", image)),
        ROUNDS,
    )
    out_of = in_turns(
        lambda: processor_ms(lambda: image_in(chunk)),
        lambda: processor_ms(lambda: cv2.imdecode(png, cv2.IMREAD_UNCHANGED)),
        ROUNDS,
    )
    return [
        side_by_side(f"frame, 5 MP of {what}: into a chunk", "CPU ms", "cv2 default PNG", *into),
        side_by_side("  out of it, whole", "CPU ms", "cv2 default PNG", *out_of),
        side_by_side("  its size", "MB", "cv2 default PNG", [len(chunk) / 1e6], [len(png) / 1e6]),
    ]


def _roi(clean: Float) -> list[Figure]:
    progress("codec, windows around the markers")
    target = load_target(packaged("targets", "paper-9x6"))
    first, image = (noisy(clean, 1.5, np.uint8, seed) for seed in (1, 2))
    keep = MarkerWindows(lambda whole: marker_windows(whole, target))
    whole, frame = chunk_of(keep(_frame(first))), _frame(image)
    partial = chunk_of(keep(frame))
    own, other = in_turns(
        lambda: processor_ms(lambda: chunk_of(keep(frame))), lambda: processor_ms(lambda: chunk_of(frame)), ROUNDS
    )
    ratios = [image.nbytes / len(partial)], [image.nbytes / len(whole)]
    search_ms = [processor_ms(lambda: marker_windows(image, target)) for _ in range(5)]
    decode_ms = [processor_ms(lambda: image_in(partial)) for _ in range(5)]
    return [
        side_by_side("roi, 5 MP with 54 windows into a chunk", "CPU ms", "whole frame", own, other),
        side_by_side("roi, ratio, noise 1.5 DN", ": 1", "whole frame", *ratios),
        absolute("roi, out of it", "CPU ms", decode_ms),
        absolute("roi, search for the windows", "CPU ms", search_ms),
    ]


def _frame(image: Image) -> Frame:
    return Frame("camera.image", image, START_NS, 0.1, 0.0, 40.0, 1, 1)


@contextmanager
def _one_thread() -> Generator[None]:
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
