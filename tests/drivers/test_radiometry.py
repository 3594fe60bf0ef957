"""Radiometric JPEGs: ours against what was written, and against flyr, an independent reader."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from pathlib import Path

import flyr
import numpy as np
import pytest

from thermostand.drivers.devices.imager.radiometric_jpeg import NotRadiometric, is_whole, parse
from thermostand.drivers.devices.imager.radiometry import Air, compute_temperatures_degC
from thermostand.drivers.sim.units.thermal_imager import HEIGHT, WIDTH, RadiometricShot, make_jpeg

SCENE_DEGC = np.linspace(-15.0, 75.0, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)
SPOTS = {"lens": (80, 60), "housing": (40, 30), "back": (120, 90)}
CAMERA_RECORD = 512  # in the block, behind 14 entries


def with_air(jpeg: bytes) -> bytes:
    """The same counts as an E40 states them: through 3 m of air and a window, with its own constants."""
    changed = bytearray(jpeg)
    begin = jpeg.index(b"FFF\0") + CAMERA_RECORD
    stated = {36: 3.0, 40: 291.0, 44: 299.0, 48: 295.0, 52: 0.9, 60: 0.4}
    stated |= {112: 0.006569, 116: 0.01262, 120: -0.002276, 124: -0.00667, 128: 1.9}
    for offset, value in stated.items():
        struct.pack_into("<f", changed, begin + offset, value)
    return bytes(changed)


def test_constants_that_no_camera_has_have_no_transmission() -> None:
    air = Air(1.0, 293.15, 0.5, alpha1=0.0, alpha2=-1.7e38, beta1=math.nan, beta2=0.0, X=1.0)
    assert math.isnan(air.transmission)
    assert math.isnan(replace(air, temperature_K=1e38).transmission)


@pytest.mark.parametrize("png", [False, True])
@pytest.mark.parametrize("emissivity", [1.0, 0.95, 0.5])
def test_what_was_written_is_read_to_half_a_count(png: bool, emissivity: float) -> None:
    image = parse(make_jpeg(RadiometricShot(SCENE_DEGC, 1.7e9 + 0.25, spots=SPOTS, png=png, emissivity=emissivity)))
    found = compute_temperatures_degC(image.counts, image.planck, image.around, emissivity)
    assert np.abs(found - SCENE_DEGC).max() < 0.006 / emissivity
    assert (image.model, image.serial_number, image.camera_s) == ("FLIR E40", "49001234", 1.7e9 + 0.25)
    assert image.spots == SPOTS
    assert image.emissivity == pytest.approx(emissivity)


@pytest.mark.parametrize("png", [False, True])
@pytest.mark.parametrize("emissivity", [0.95, 0.6])
def test_another_reader_finds_the_same_temperatures(png: bool, emissivity: float, tmp_path: Path) -> None:
    data = with_air(make_jpeg(RadiometricShot(SCENE_DEGC, 1.7e9, spots=SPOTS, png=png)))
    (tmp_path / "one.jpg").write_bytes(data)
    image = parse(data)
    ours = compute_temperatures_degC(image.counts, image.planck, image.around, emissivity)
    peer = flyr.unpack(str(tmp_path / "one.jpg"))
    assert np.abs(ours - peer.adjust_metadata(emissivity=emissivity).celsius).max() < 0.002
    assert np.abs(ours - SCENE_DEGC).max() > 1.0  # the air and the window do matter
    assert {each.label: tuple(each.params) for each in peer.measurements} == SPOTS


def test_a_picture_of_two_segments_is_put_together(tmp_path: Path) -> None:
    large = np.tile(SCENE_DEGC, (2, 2))
    data = make_jpeg(RadiometricShot(large, 1.7e9))
    assert data.count(b"FLIR\0\x01") == 3
    image = parse(data)
    assert np.abs(compute_temperatures_degC(image.counts, image.planck, image.around, 1.0) - large).max() < 0.006


def test_a_temperature_without_answer_is_nan() -> None:
    image = parse(make_jpeg(RadiometricShot(SCENE_DEGC, 0.0)))
    dark = np.array([[0, 1]], np.uint16)
    assert np.isnan(compute_temperatures_degC(dark, image.planck, image.around, 0.05)).all()


def test_counts_in_the_other_byte_order_and_a_tool_that_is_none_are_read_as_such() -> None:
    """As the fact sheet has them: subtype 1 is big endian, by its header; tool 7 is unused."""
    data = make_jpeg(RadiometricShot(SCENE_DEGC, 0.0, spots=SPOTS))
    little, sound = struct.pack("<9H", 2, WIDTH, HEIGHT, 0, 0, 0, WIDTH - 1, 0, HEIGHT - 1), parse(data)
    begin = data.index(little)
    end = begin + 32 + 2 * WIDTH * HEIGHT
    words = np.frombuffer(data[begin:end], "<u2").astype(">u2").tobytes()
    changed = bytearray(data[:begin] + words + data[end:])
    changed[data.index("lens".encode("utf-16-le")) - 40 + 10] = 7
    image = parse(bytes(changed))
    assert np.array_equal(image.counts, sound.counts)
    assert image.spots == {name: place for name, place in SPOTS.items() if name != "lens"}


def one_segment_twice(data: bytes) -> bytes:
    at = data.index(b"\xff\xe1")
    return data[:at] + data[at : at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")] + data[at:]


@pytest.mark.parametrize(
    ("damage", "why"),
    [
        (lambda data: data[2:], "no JPEG"),
        (lambda data: data.replace(b"FLIR\0", b"EXIF\0"), "without temperatures"),
        (one_segment_twice, "twice"),
        (lambda data: data.replace(b"FLIR\0\x01\0\0", b"FLIR\0\x01\0\x01"), "segments up to 1"),
        (lambda data: data.replace(b"FFF\0", b"FFG\0"), "no FFF"),
        (lambda data: data.replace(b"\0\x20\0\0\0\0\0\x6f", b"\0\0\0\0\0\0\0\x6f"), "lacks the counts or the camera"),
        (lambda data: data.replace(b"\0\0\0\x64", b"\0\0\0\x63", 1), "version"),
        (lambda data: data.replace(struct.pack("<3H", 2, WIDTH, HEIGHT), struct.pack("<3H", 2, 0, HEIGHT)), "px"),
        (lambda data: data.replace(struct.pack("<3H", 2, WIDTH, HEIGHT), struct.pack("<3H", 7, 1, 1)), "header"),
    ],
)
def test_what_is_none_is_refused_with_the_reason(damage, why: str) -> None:
    with pytest.raises(NotRadiometric, match=why):
        parse(damage(make_jpeg(RadiometricShot(SCENE_DEGC, 0.0))))


def test_a_damaged_one_is_refused_and_a_cut_one_is_not_whole() -> None:
    shot = RadiometricShot(SCENE_DEGC, 0.0)
    with pytest.raises(NotRadiometric, match="ends behind the block"):
        parse(make_jpeg(shot, is_damaged=True))
    data = make_jpeg(shot)
    assert is_whole(data)
    assert is_whole(data + bytes(512))
    assert not is_whole(data[:-3])
    assert not is_whole(b"")
