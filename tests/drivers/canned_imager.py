"""The reader of radiometric JPEGs, on damaged files."""

from __future__ import annotations

import numpy as np

from tests.drivers.canned_line import Feed, Parser
from thermostand.drivers.devices.imager.radiometric_jpeg import NotRadiometric, is_whole, parse
from thermostand.drivers.devices.imager.radiometry import compute_temperatures_degC
from thermostand.drivers.sim.units.thermal_imager import RadiometricShot, compute_counts, make_jpeg

_SCENE_DEGC = np.linspace(10.0, 50.0, 64).reshape(8, 8)
_SPOTS = {"lens": (3, 4), "1": (5, 5)}
_SHOTS = [RadiometricShot(_SCENE_DEGC, 1.7e9, spots=_SPOTS, png=png, emissivity=0.95) for png in (False, True)]


def radiometric() -> Parser:
    """Small pictures, so that the directory and the records are hit, too."""
    frames = [make_jpeg(shot) for shot in _SHOTS]
    sound = [frame.index(b"FFF\0") for frame in frames]

    def make() -> Feed:
        def feed(number: int, wire: bytes) -> bool:
            is_whole(wire)
            try:
                image = parse(wire)
            except NotRadiometric:
                return False
            degC = compute_temperatures_degC(image.counts, image.planck, image.around, 0.95)
            assert degC.shape == image.counts.shape
            assert not np.isinf(degC).any()
            begin, frame = sound[number], frames[number]
            if wire[begin : begin + len(frame)] == frame[begin:]:  # damaged before its temperatures only
                assert np.array_equal(image.counts, compute_counts(_SCENE_DEGC, 0.95))
            return True

        return feed

    return Parser(frames, make)
