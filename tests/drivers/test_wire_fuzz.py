"""Damaged frames: no parser crashes, runs without end, or takes a wrong value for a right one."""

import random

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.drivers.canned_camera import gvcp_commands
from tests.drivers.canned_chambers import ascii2, cts, cts_state, espec, espec_monitor, julabo, simserv, texts
from tests.drivers.canned_devices import jrk, modbus, ximc
from tests.drivers.canned_imager import radiometric
from tests.drivers.canned_line import Parser, mutated

PARSERS: dict[str, Parser] = {
    "XIMC": ximc(),
    "Modbus RTU": modbus("serial"),
    "Modbus TCP": modbus("tcp"),
    "ASCII-2": ascii2(),
    "ESPEC": espec(),
    "CTS serial": cts("serial"),
    "CTS TCP": cts("tcp"),
    "ESPEC state": espec_monitor(),
    "CTS state serial": cts_state("serial"),
    "CTS state TCP": cts_state("tcp"),
    "SIMSERV": simserv(),
    "Julabo": julabo(),
    "Hart": texts("hart"),
    "Vaisala": texts("vaisala"),
    "Jrk variables": jrk(),
    "GVCP": gvcp_commands(),
    "FFF": radiometric(),
}

_QUICK, _LONG = 1_000, 1_000_000

parsers = pytest.mark.parametrize("name", PARSERS)


@parsers
def test_recorded_frames_are_taken(name: str) -> None:
    parser = PARSERS[name]
    feed = parser.make()
    refused = {number for number, frame in enumerate(parser.frames) if not feed(number, frame)}
    assert refused == parser.refusals


@parsers
@pytest.mark.parametrize("inputs", [_QUICK, pytest.param(_LONG, marks=pytest.mark.nightly)])
def test_damaged_frames_are_refused_or_read_for_what_they_say(name: str, inputs: int) -> None:
    chance, parser = random.Random(name), PARSERS[name]
    feed = parser.make()
    for _ in range(inputs):
        number = chance.randrange(len(parser.frames))
        wire = mutated(chance, parser.frames, number)
        try:
            feed(number, wire)
        except Exception as error:
            raise AssertionError(f"frame {number} as {wire[:400].hex(' ')}") from error


# Taken once, though they are not what a unit sends.
FOUND = (
    ("Modbus TCP", 6, "00 01 00 00 00 07 01 10 0a de 00 02 00 02"),  # longer than address and count
    ("Modbus TCP", 5, "00 01 00 00 00 06 01 85 00 00 00 00"),  # an exception without a number
)


@pytest.mark.parametrize(("name", "number", "wire"), FOUND)
def test_what_was_found_is_refused(name: str, number: int, wire: str) -> None:
    assert not PARSERS[name].make()(number, bytes.fromhex(wire))


@parsers
@settings(max_examples=50, deadline=None, derandomize=True)
@example(wire=b"")
@given(wire=st.binary(max_size=600))
def test_any_bytes_are_refused_or_read_for_what_they_say(name: str, wire: bytes) -> None:
    PARSERS[name].make()(0, wire)
