"""What an image costs as a message: processor time and size, beside OpenCV's defaults and the entropy of the noise.

The frames are 5 MP of the target in uneven light with Gaussian noise of a known sigma. No lossless codec can spend less
than the entropy of the rounded noise, even if it knew the noise-free image. Times are of the processor, so that other
programs of the machine count less; OpenCV has one thread.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from numpy.typing import NDArray

from tests.bench.figures import Figure, absolute, at_most, in_turns, progress, ratio_at_least, side_by_side
from tests.compensation.rendered import Scene, render, shaded_light
from thermostand.compensation.finding.png_rows import decode_rows
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.readings import Frame
from thermostand.markers.detection import detect, rows_to_follow
from thermostand.markers.target import load_target
from thermostand.markers.windows import marker_windows
from thermostand.recording.format.images import IMAGE_CLASS, decode_image, encode_image
from thermostand.recording.format.roi import RoiEncoder
from thermostand.stand.config.stand_config import packaged

ROUNDS = 11
START_NS = 1_767_290_400 * NS_PER_S
SIGMAS_DN = (1.0, 1.5, 2.0)
SIGMAS_12_BIT_DN = (3.0, 24.0)  # the second is 1.5 DN of 8 bit
PNG = IMAGE_CLASS["png"].DESCRIPTOR.full_name
LIMIT = "entropy of the noise"

Image = NDArray[np.uint8] | NDArray[np.uint16]
Float = NDArray[np.float64]


def figures(directory: Path) -> list[Figure]:
    """ms and ratios of PNG at 8 and 12 bit, and of the windows around the markers."""
    progress("codec, rendering the frames")
    clean = render(Scene(ground_DN=170.0, light=shaded_light))
    image = noisy(clean, 1.5, np.uint8, 1)
    with _one_thread():
        return [
            *_png(image),
            *(_of_limit("png, 8 bit", noisy(clean, sigma_DN, np.uint8, 1), sigma_DN) for sigma_DN in SIGMAS_DN),
            _of_filter(image),
            *_twelve_bit(clean * 16),
            *_roi(clean),
        ]


def noisy(clean_DN: Float, sigma_DN: float, dtype: type[np.uint8] | type[np.uint16], seed: int) -> Image:
    """The clean image with Gaussian noise, rounded; it stays clear of the ends of its range."""
    rng = np.random.default_rng(seed)
    noisy: Any = np.round(clean_DN + rng.normal(0, sigma_DN, clean_DN.shape)).astype(dtype)
    return noisy


def rounded_noise_bit(sigma_DN: float) -> float:
    """Entropy of Gaussian noise rounded to whole DN, bit per pixel; from sigma 1 on it is the same wherever between
    two whole values the mean lies."""
    reach = math.ceil(10 * sigma_DN)
    edges = [0.5 * math.erfc(-(k - 0.5) / sigma_DN / math.sqrt(2)) for k in range(-reach, reach + 2)]
    return -sum(part * math.log2(part) for part in np.diff(edges).tolist() if part > 0)


def _png(image: Image) -> list[Figure]:
    progress("codec, 8 bit")
    data = encode_image(_frame(image), "png")
    png = cv2.imencode(".png", image)[1]
    encoded = in_turns(
        lambda: _cpu_ms(lambda: encode_image(_frame(image), "png")),
        lambda: _cpu_ms(lambda: cv2.imencode(".png", image)),
        ROUNDS,
    )
    decoded = in_turns(
        lambda: _cpu_ms(lambda: decode_image(PNG, data)),
        lambda: _cpu_ms(lambda: cv2.imdecode(png, cv2.IMREAD_UNCHANGED)),
        ROUNDS,
    )
    message = CompressedImage.FromString(data).data
    room = np.empty_like(image, np.uint8)
    for_fit = in_turns(
        lambda: _cpu_ms(lambda: decode_rows(message, room)),
        lambda: _cpu_ms(lambda: cv2.imdecode(np.frombuffer(message, np.uint8), cv2.IMREAD_UNCHANGED)),
        ROUNDS,
    )
    target = load_target(packaged("targets", "paper-9x6"))
    rows = rows_to_follow(detect(image, target), target, len(image))
    in_part = in_turns(
        lambda: _cpu_ms(lambda: decode_rows(message, room, rows)),
        lambda: _cpu_ms(lambda: decode_rows(message, room)),
        ROUNDS,
    )
    sizes_MB = [len(data) / 1e6], [len(png) / 1e6]
    return [
        at_most(25, side_by_side("png, encode 5 MP of 8 bit", "CPU ms", "cv2 default PNG", *encoded)),
        side_by_side("png, decode it", "CPU ms", "cv2 default PNG", *decoded),
        side_by_side("png, decode it for the fit", "CPU ms", "cv2, the same PNG", *for_fit),
        side_by_side("png, decode the rows that a tracker needs", "CPU ms", "all rows", *in_part),
        side_by_side("png, its size", "MB", "cv2 default PNG", *sizes_MB),
    ]


def _of_limit(what: str, image: Image, sigma_DN: float) -> Figure:
    """How many times smaller the message is than the image, and may be."""
    ratio = image.nbytes / len(encode_image(_frame(image), "png"))
    limit = 8 * image.itemsize / rounded_noise_bit(sigma_DN)
    figure = side_by_side(f"{what}, noise {sigma_DN:g} DN", ": 1", LIMIT, [ratio], [limit])
    return ratio_at_least(0.9, figure) if image.itemsize == 1 and sigma_DN == 1.5 else figure


def _of_filter(image: Image) -> Figure:
    """The same beside the entropy of what PNG's average filter leaves, with codes of their own for each 16 rows: no
    Huffman code is shorter, and of the five filters this one leaves least."""
    left, above = np.zeros_like(image), np.zeros_like(image)
    left[:, 1:], above[1:] = image[:, :-1], image[:-1]
    rest: Any = image - ((left & above) + ((left ^ above) >> 1))
    bit = [_entropy_bit(rest[row : row + 16]) for row in range(0, len(rest), 16)]
    ratio = image.nbytes / len(encode_image(_frame(image), "png"))
    return side_by_side(
        "png, 8 bit, noise 1.5 DN", ": 1", "entropy behind the filter", [ratio], [8 * len(bit) / sum(bit)]
    )


def _entropy_bit(values: Image) -> float:
    share = np.bincount(values.ravel()) / values.size
    share = share[share > 0]
    return float(-(share * np.log2(share)).sum())


def _twelve_bit(clean_DN: Float) -> list[Figure]:
    progress("codec, 12 bit")
    images = {sigma_DN: noisy(clean_DN, sigma_DN, np.uint16, 1) for sigma_DN in SIGMAS_12_BIT_DN}
    image = images[SIGMAS_12_BIT_DN[-1]]
    own, other = in_turns(
        lambda: _cpu_ms(lambda: encode_image(_frame(image), "png")),
        lambda: _cpu_ms(lambda: cv2.imencode(".png", image)),
        ROUNDS // 2,
    )
    return [
        side_by_side("png, encode 5 MP of 12 bit", "CPU ms", "cv2 default PNG", own, other),
        *(_of_limit("png, 12 bit in 16", image, sigma_DN) for sigma_DN, image in images.items()),
    ]


def _roi(clean: Float) -> list[Figure]:
    progress("codec, windows around the markers")
    target = load_target(packaged("targets", "paper-9x6"))
    first, image = (noisy(clean, 1.5, np.uint8, seed) for seed in (1, 2))
    encoder = RoiEncoder(lambda whole: marker_windows(whole, target))
    whole, frame = encoder(_frame(first)), _frame(image)
    partial = encoder(frame)
    own, other = in_turns(
        lambda: _cpu_ms(lambda: encoder(frame)), lambda: _cpu_ms(lambda: encode_image(frame, "png")), ROUNDS
    )
    ratios = [image.nbytes / len(partial)], [image.nbytes / len(whole)]
    search_ms = [_cpu_ms(lambda: marker_windows(image, target)) for _ in range(5)]
    decode_ms = [_cpu_ms(lambda: decode_image(PNG, partial)) for _ in range(5)]
    return [
        side_by_side("roi, encode 5 MP, 54 windows", "CPU ms", "whole frame", own, other),
        side_by_side("roi, ratio, noise 1.5 DN", ": 1", "whole frame", *ratios),
        absolute("roi, decode it", "CPU ms", decode_ms),
        absolute("roi, search for the windows", "CPU ms", search_ms),
    ]


def _frame(image: Image) -> Frame:
    return Frame("camera.image", image, START_NS, 0.1, 0.0, 40.0, 1, 1)


def _cpu_ms(work: Callable[[], object]) -> float:
    begin_s = time.process_time()
    work()
    return 1e3 * (time.process_time() - begin_s)


@contextmanager
def _one_thread() -> Generator[None]:
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
