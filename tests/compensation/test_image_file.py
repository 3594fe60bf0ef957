"""Image files that claim more than a computer has: refused by their header, before any memory is taken."""

from __future__ import annotations

import resource
import struct
import subprocess
import sys
import zlib
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from typer.testing import CliRunner

from thermostand.compensation.cli import app
from thermostand.foundation.errors import SessionError
from thermostand.foundation.image_limit import allow_images_up_to
from thermostand.markers.detection import DetectionError
from thermostand.markers.image_file import read_image
from thermostand.recording.format.images import decode_image

LIMIT_S = 600  # of a program that hangs; the slowest takes half a minute on a quiet machine
MOST_BYTES = 1_500_000_000


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


@cache
def png(width: int, height: int, depth: int = 8, colour: int = 0, pixels: bytes | None = None) -> bytes:
    """All black; `pixels` instead of what such an image has."""
    samples = {0: 1, 2: 3, 6: 4}[colour]
    if pixels is None:
        packer = zlib.compressobj(1)
        row = bytes(1 + (width * samples * depth + 7) // 8)
        pixels = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def bmp(width: int, height: int) -> bytes:
    return (
        b"BM" + struct.pack("<IHHIIiiHHIIiiII", 100, 0, 0, 54, 40, width, height, 1, 24, 0, 46, 0, 0, 0, 0) + bytes(46)
    )


def tiff(width: int, height: int) -> bytes:
    tags = [(256, 4, width), (257, 4, height), (258, 3, 8), (259, 3, 1), (262, 3, 1), (273, 4, 8), (279, 4, 9)]
    entries = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in tags)
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(4)


def jpeg(width: int, height: int) -> bytes:
    _, small = cv2.imencode(".jpg", np.zeros((8, 8), np.uint8))
    data = bytearray(small.tobytes())
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", height, width)
    return bytes(data)


CLAIMS = {
    "png": lambda: png(16_000, 16_000),
    "png of colours": lambda: png(60_000, 60_000, 16, 6, b""),
    "png of bits": lambda: png(2_000_000_000, 2_000_000_000, 1, 0, b""),
    "bmp": lambda: bmp(40_000, 40_000),
    "tiff": lambda: tiff(60_000, 60_000),
    "jpeg": lambda: jpeg(65_000, 65_000),
    "pgm": lambda: b"P5 50000 50000 255\n" + bytes(100),
}


@pytest.mark.parametrize("claim", CLAIMS)
def test_a_file_that_claims_too_many_pixels_is_refused_unread(tmp_path: Path, claim: str):
    path = tmp_path / "photo.png"
    path.write_bytes(CLAIMS[claim]())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(
        DetectionError, match=r"photo\.png: claims .* px; up to 70 megapixels .*--max-megap|far more pixels"
    ):
        read_image(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000


def detect(*arguments: object) -> str:
    """What it says when it refuses."""
    result = CliRunner().invoke(app, ["detect", *map(str, arguments)])
    assert result.exit_code == 1
    return result.output


def test_what_is_read_may_be_chosen(tmp_path: Path):
    path, out = tmp_path / "photo.png", tmp_path / "markers.csv"
    path.write_bytes(png(1000, 1000))
    answer = detect(path, "-o", out, "--max-megapixels", "0.9")
    assert answer.startswith(f"error: {path}: claims 1000 x 1000 px; up to 0.9 megapixels are read")
    assert "found 0 of 54 markers" in detect(path, "-o", out, "--max-megapixels", "1")
    with allow_images_up_to(100):
        path.write_bytes(png(9_000, 9_000))
        assert read_image(path).shape == (9_000, 9_000)


def test_recorded_images_have_the_same_limit():
    raw = RawImage(width=70_001, height=1000, encoding="mono8", step=70_001, data=bytes(70_001_000))
    with pytest.raises(SessionError, match=r"a recorded image claims .* px; up to 70 megapixels are read"):
        decode_image(raw.SerializeToString())


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["black", "noise", "dots", "colours of 16 bit"])
def test_the_largest_images_take_less_memory_than_a_small_computer_has(tmp_path: Path, kind: str):
    side = 8366
    image = np.full((side, side), 200, np.uint8)
    match kind:
        case "black":
            image[:] = 0
        case "noise":
            image[:] = np.random.default_rng(1).integers(80, 100, (side, side), np.uint8)
        case "dots":
            for y in range(100, side - 100, 160):
                for x in range(100, side - 100, 160):
                    cv2.circle(image, (x, y), 30, 40, -1)
        case _:
            image = np.full((side, side, 4), 30_000, np.uint16)
    path = tmp_path / "large.png"
    cv2.imwrite(str(path), image)
    code = f"""if True:
        import resource, sys
        from thermostand.compensation.cli import app
        try:
            app(["detect", {str(path)!r}, "-o", {str(tmp_path / "m.csv")!r}])
        finally:
            sys.stdout.write(str(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024))
    """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert "error: large.png: found " in done.stderr
    assert int(done.stdout) < MOST_BYTES
