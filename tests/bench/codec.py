"""What a frame costs as a chunk: processor time and size, beside OpenCV's PNG and other lossless codecs.

The frames are 5 MP of the target in uneven light with Gaussian noise of a known sigma, one of the simulator's, and two
with a real sensor's noise.
Times are of one thread of the processor, so that other programs of the machine count less.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.records import Channel
from mcap.writer import CompressionType
from numpy.typing import NDArray

from tests.bench.figures import (
    Figure,
    compare,
    make_absolute,
    make_skipped,
    measure_in_turns,
    measure_processor_ms,
    report_progress,
)
from tests.compensation.renderer import Scene, make_shaded_light, render
from tests.recording.frame_records import make_frame_records
from thermostand.drivers.sim.physics.plant import Plant, PlantSpec
from thermostand.drivers.sim.physics.scene import SceneSpec, SimulatedScene
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.readings import Frame
from thermostand.markers.target import load_target
from thermostand.markers.windows import find_marker_windows
from thermostand.recording.format.images import ZSTD_LEVEL, ImageArray, MarkerWindows, decode_image
from thermostand.recording.format.mcap_bytes import LENGTH, RECORD, decompress_chunk
from thermostand.recording.format.records import parse_frame_messages
from thermostand.recording.writing.mcap_writer import McapWriter
from thermostand.recording.writing.segment import CHUNK_BYTES
from thermostand.stand.config.stand_config import find_packaged

ROUNDS = 11
PEER_ROUNDS = 3  # each takes up to some seconds
START_NS = 1_767_290_400 * NS_PER_S

Image = NDArray[np.uint8] | NDArray[np.uint16]
Float = NDArray[np.float64]


def figures(directory: Path) -> list[Figure]:
    """ms and ratios of frames of 8 and 12 bit, and of the windows around the markers."""
    report_progress("codec, rendering the frames")
    clean = render(Scene(ground_DN=170.0, light=make_shaded_light))
    simulated = SimulatedScene(SceneSpec(), 1).render(
        Plant(PlantSpec(), START_NS).optics(START_NS), START_NS, 0.1, 0, 1
    )
    with _use_one_thread():
        return [
            *_measure_costs("8 bit", add_noise(clean, 1.5, np.uint8, 1)),
            *_measure_costs("8 bit of the demo", simulated),
            *_measure_costs("12 bit, noise 24 DN", add_noise(clean * 16, 24.0, np.uint16, 1)),
            *_measure_roi(clean),
            *(row for bits in (8, 12) for row in _compare_codecs(clean, bits)),
        ]


def add_noise(clean_DN: Float, sigma_DN: float, dtype: type[np.uint8] | type[np.uint16], seed: int) -> Image:
    """The clean image with Gaussian noise, rounded; it stays clear of the ends of its range."""
    rng = np.random.default_rng(seed)
    noisy: Any = np.round(clean_DN + rng.normal(0, sigma_DN, clean_DN.shape)).astype(dtype)
    return noisy


# A real sensor's noise, measured after EMVA 1288: the results that the standard's reference implementation publishes
# (github.com/EMVA1288/emva1288, doc/datasets/datasets_results.rst; it saturates at 13,973 electrons): overall system
# gain, temporal dark noise. The offset is ours.
GAIN_DN_PER_E, DARK_NOISE_E, OFFSET_DN = 0.2808, 10.90, 64.0


def add_sensor_noise(clean_DN: Float, bits: int, seed: int) -> Image:
    """The clean image of 8 bit levels as that sensor has it in so many bits: Poisson noise of the electrons, dark noise
    and rounding."""
    rng = np.random.default_rng(seed)
    electrons = rng.poisson(clean_DN * 16 / GAIN_DN_PER_E) + rng.normal(0, DARK_NOISE_E, clean_DN.shape)
    levels = np.clip((OFFSET_DN + GAIN_DN_PER_E * electrons) / 2 ** (12 - bits), 0, 2**bits - 1)
    made: Any = np.round(levels).astype(np.uint8 if bits == 8 else np.uint16)
    return made


def _make_peer_codecs(bits: int) -> dict[str, tuple[Callable[[Any], Any], Callable[[Any], Any]]]:
    """Lossless codecs by their names, one thread each, at the levels that their makers take."""
    import imagecodecs as codecs  # pyright: ignore[reportMissingImports] - optional

    return {
        "PNG (zlib 6)": (lambda image: codecs.png_encode(image, level=6), codecs.png_decode),
        "JPEG-LS": (codecs.jpegls_encode, codecs.jpegls_decode),
        "JPEG XL (effort 3)": (
            lambda image: codecs.jpegxl_encode(image, lossless=True, effort=3, bitspersample=bits, numthreads=1),
            lambda data: codecs.jpegxl_decode(data, numthreads=1),
        ),
        "HTJ2K": (lambda image: codecs.htj2k_encode(image, reversible=True), codecs.htj2k_decode),
        "blosc2 (zstd 1, bit shuffle)": (
            lambda image: codecs.blosc2_encode(
                image, level=1, compressor="zstd", shuffle="bitshuffle", typesize=image.itemsize, numthreads=1
            ),
            lambda data: codecs.blosc2_decode(data, numthreads=1),
        ),
    }


def _compare_codecs(clean: Float, bits: int) -> list[Figure]:
    """The recorded form beside other lossless ones: size, and time into and out of each."""
    what, image = f"{bits} bit, a real sensor's noise", add_sensor_noise(clean, bits, 1)
    if find_spec("imagecodecs") is None:
        return [make_skipped(f"{what}: other codecs", "pip install imagecodecs")]
    chunk, found = encode_chunk(_make_frame(image)), list[Figure]()
    for name, (encode, decode) in _make_peer_codecs(bits).items():
        report_progress(f"codec, {what}, {name}")
        data = encode(image)
        back = np.frombuffer(decode(data), image.dtype) if name.startswith("blosc2") else decode(data)
        if not np.array_equal(np.reshape(back, image.shape), image):
            raise ValueError(f"{name} is not lossless")
        into, out_of = (
            measure_in_turns(partial(measure_processor_ms, own), partial(measure_processor_ms, other), PEER_ROUNDS)
            for own, other in (
                (lambda: encode_chunk(_make_frame(image)), partial(encode, image)),
                (lambda: decode_chunk(chunk), partial(decode, data)),
            )
        )
        found += [
            compare(f"{what}: size", "MB", name, [len(chunk) / 1e6], [len(data) / 1e6]),
            compare("  into it", "CPU ms", name, *into),
            compare("  out of it", "CPU ms", name, *out_of),
        ]
    return found


def encode_chunk(frame: Frame) -> bytes:
    """The frame as the recorder's chunk, with what stands behind it."""
    writer = McapWriter(CompressionType.ZSTD, CHUNK_BYTES, ZSTD_LEVEL)
    writer.take()
    for number, record in enumerate(make_frame_records(frame), 1):
        writer.digest.know(Channel(id=number, topic=str(number), message_encoding="", schema_id=0, metadata={}), None)
        writer.add_message(number, record.time_ns, record.published_ns, record.sequence, record.data)
    writer.end_chunk()
    return b"".join(writer.take())


def decode_chunk(chunk: bytes) -> ImageArray:
    """The image in it, its CRC checked."""
    (length,) = LENGTH.unpack_from(chunk, 1)
    _, data = decompress_chunk(memoryview(chunk)[RECORD.size : RECORD.size + length])
    return decode_image(parse_frame_messages(data)[1].data)


def _measure_costs(what: str, image: Image) -> list[Figure]:
    report_progress(f"codec, {what}")
    chunk, (_, png) = encode_chunk(_make_frame(image)), cv2.imencode(".png", image)
    into = measure_in_turns(
        lambda: measure_processor_ms(lambda: encode_chunk(_make_frame(image))),
        lambda: measure_processor_ms(lambda: cv2.imencode(".png", image)),
        ROUNDS,
    )
    out_of = measure_in_turns(
        lambda: measure_processor_ms(lambda: decode_chunk(chunk)),
        lambda: measure_processor_ms(lambda: cv2.imdecode(png, cv2.IMREAD_UNCHANGED)),
        ROUNDS,
    )
    return [
        compare(f"frame, 5 MP of {what}: into a chunk", "CPU ms", "cv2 default PNG", *into),
        compare("  out of it, whole", "CPU ms", "cv2 default PNG", *out_of),
        compare("  its size", "MB", "cv2 default PNG", [len(chunk) / 1e6], [len(png) / 1e6]),
    ]


def _measure_roi(clean: Float) -> list[Figure]:
    report_progress("codec, windows around the markers")
    target = load_target(find_packaged("targets", "paper-9x6"))
    first, image = (add_noise(clean, 1.5, np.uint8, seed) for seed in (1, 2))
    keep = MarkerWindows(lambda whole: find_marker_windows(whole, target))
    whole, frame = encode_chunk(keep(_make_frame(first))), _make_frame(image)
    partial = encode_chunk(keep(frame))
    own, other = measure_in_turns(
        lambda: measure_processor_ms(lambda: encode_chunk(keep(frame))),
        lambda: measure_processor_ms(lambda: encode_chunk(frame)),
        ROUNDS,
    )
    ratios = [image.nbytes / len(partial)], [image.nbytes / len(whole)]
    search_ms = [measure_processor_ms(lambda: find_marker_windows(image, target)) for _ in range(5)]
    decode_ms = [measure_processor_ms(lambda: decode_chunk(partial)) for _ in range(5)]
    return [
        compare("roi, 5 MP with 54 windows into a chunk", "CPU ms", "whole frame", own, other),
        compare("roi, ratio, noise 1.5 DN", ": 1", "whole frame", *ratios),
        make_absolute("roi, out of it", "CPU ms", decode_ms),
        make_absolute("roi, search for the windows", "CPU ms", search_ms),
    ]


def _make_frame(image: Image) -> Frame:
    return Frame("camera.image", image, START_NS, 0.1, 0.0, 40.0, 1, 1)


@contextmanager
def _use_one_thread() -> Generator[None]:
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
