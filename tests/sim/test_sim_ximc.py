"""What the fake controllers answer, byte for byte."""

import struct

import pytest

from tests.sim.ximc_bench import (
    ERRC,
    ERRD,
    ERRV,
    SETTING_SIZES,
    Bench,
)
from thermostand.drivers.framing.ximc import encode

QUERY_SIZES = {
    "gets": 54, "gpos": 26, "getm": 216, "geti": 36, "gser": 10, "gfwv": 10, "gblv": 10, "getc": 38, "guid": 40,
    "rdan": 76,
}  # fmt: skip
SERVICE_SIZES = {
    "sser": 50, "dbgr": 4, "dbgw": 142, "updf": 4, "clfr": 4, "gofw": 4, "hasf": 4, "wkey": 46, "conn": 14, "disc": 14,
    "wdat": 142, "rest": 4, "irnd": 4,
}  # fmt: skip

# A conversation of libximc 3.1.1 with the linear stage, requests as sent; it fills reserved bytes with 0xCC.
LIBXIMC_REQUESTS = [
    bytes.fromhex(text)
    for text in (
        "67657469", "67736572", "67667776", "67657473", "676d6f76",
        "736d6f768813000000204e204ee80300000000cccccccccccccccccc761b", "67686f6d",
        "73686f6db80b000000f401000000f401000000007201cccccccccccccccccc9713", "67656e67", "676e6d65", "686f6d65",
        "67657473", "7a65726f", "6d6f7665900100009cffcccccccccccc0eaf", "6d6f7672640000003200cccccccccccc3c66",
        "73746f70", "73737470", "67706f73", "736d6f7688130000000000204ee80300000000cccccccccccccccccc8ae3",
    )
]  # fmt: skip


def test_the_controller_says_who_it_is(linear: Bench) -> None:
    assert linear.ask("gser", size=10) == struct.pack("<I", 0x1234)
    assert linear.ask("geti", size=36) == struct.pack("<4s2s8sBBH12x", b"XIMC", b"SM", b"XISM-USB", 2, 3, 8)
    assert linear.ask("gfwv", size=10) == struct.pack("<BBH", 4, 7, 6)


@pytest.mark.parametrize(("letters", "size"), QUERY_SIZES.items())
def test_every_query_is_answered_in_its_size(linear: Bench, letters: str, size: int) -> None:
    assert len(linear.ask(letters, size=size)) == size - 6


@pytest.mark.parametrize(("name", "size"), SETTING_SIZES.items())
def test_every_setting_is_written_as_it_is_read(linear: Bench, name: str, size: int) -> None:
    payload = linear.ask("g" + name, size=size)
    assert linear.engine.feed(encode("s" + name, payload)) == encode("s" + name)
    assert linear.ask("g" + name, size=size) == payload


@pytest.mark.parametrize("letters", ["stms", "sars", "rers", "eesv", "eerd", "asia", "save", "read"])
def test_commands_without_effect_are_acknowledged(linear: Bench, letters: str) -> None:
    linear.ask(letters, bytes(16) if letters == "asia" else b"")
    assert linear.status().command == 0


@pytest.mark.parametrize("pieces", [(1,), (3, 7, 1, 2), (5,), (64, 1)])
def test_requests_of_libximc_are_understood_in_ugly_chunks(linear: Bench, pieces: tuple[int, ...]) -> None:
    whole = Bench("linear")
    expected = b"".join(whole.engine.feed(request) for request in LIBXIMC_REQUESTS)
    assert expected[-4:] == b"errv"
    wire, reply, turn = b"".join(LIBXIMC_REQUESTS), b"", 0
    while wire:
        size = pieces[turn % len(pieces)]
        reply += linear.engine.feed(wire[:size])
        wire, turn = wire[size:], turn + 1
    assert reply == expected
    assert b"errc" not in reply
    assert b"errd" not in reply


def test_reserved_bytes_are_ignored_and_read_as_zero(linear: Bench) -> None:
    linear.engine.feed(LIBXIMC_REQUESTS[5])
    assert linear.ask("gmov", size=30) == struct.pack("<IBHHIBB9x", 5_000, 0, 20_000, 20_000, 1_000, 0, 0)


def test_zeros_between_frames_come_back_one_for_one(linear: Bench) -> None:
    assert linear.engine.feed(bytes(64)) == bytes(64)
    assert linear.engine.feed(b"\0\0stms\0") == b"\0\0stms\0"


def test_zeros_inside_a_frame_complete_it_and_then_come_back(linear: Bench) -> None:
    request = encode("move", struct.pack("<ih6x", 400, 0))
    assert linear.engine.feed(request[:10]) == b""
    assert linear.engine.feed(bytes(64)) == b"errd" + bytes(64 - 8)
    assert linear.status().command == 0


def test_a_partial_frame_is_forgotten_after_400_ms(linear: Bench) -> None:
    linear.engine.feed(b"move\x01\x02")
    linear.real_s = 0.39
    assert linear.engine.feed(b"\0") == b""
    linear.real_s = 0.80
    assert linear.engine.feed(b"stms") == b"stms"


def test_a_wrong_crc_is_answered_and_latched_until_stop(linear: Bench) -> None:
    request = bytearray(encode("move", struct.pack("<ih6x", 400, 0)))
    request[-1] ^= 1
    assert linear.engine.feed(bytes(request)) == b"errd"
    assert (linear.status().flags & 7, linear.status().command) == (ERRD, 0)
    linear.ask("stop")
    assert linear.status().flags & 7 == 0


def test_an_unknown_command_is_answered_and_its_payload_is_taken_for_letters(linear: Bench) -> None:
    assert linear.engine.feed(b"xyzwABCDstms") == b"errcerrcstms"
    assert linear.status().flags & 7 == ERRC


@pytest.mark.parametrize(("letters", "size"), SERVICE_SIZES.items())
def test_service_commands_are_refused_whole(linear: Bench, letters: str, size: int) -> None:
    request = encode(letters, b"\x55" * max(0, size - 6))
    assert len(request) == size
    assert linear.engine.feed(request + b"stms") == b"errcstms"


def test_connections_have_partial_frames_of_their_own(linear: Bench) -> None:
    other = linear.axis.engine(lambda: 0.0)
    assert linear.engine.feed(b"st") == b""
    assert other.feed(b"stms") == b"stms"
    assert linear.engine.feed(b"ms") == b"stms"


@pytest.mark.parametrize(
    ("name", "layout", "index", "wrong", "corrected"),
    [
        ("mov", "<IBHHIBB9x", 0, 100_001, 100_000),
        ("mov", "<IBHHIBB9x", 2, 0, 1),
        ("eng", "<HHIBHhBH12x", 1, 14, 15),
        ("eng", "<HHIBHhBH12x", 6, 10, 9),
        ("pwr", "<BHHHB6x", 0, 101, 100),
    ],
)
def test_a_value_out_of_range_is_corrected_and_reported(
    linear: Bench, name: str, layout: str, index: int, wrong: int, corrected: int
) -> None:
    values = list(struct.unpack(layout, linear.ask("g" + name, size=SETTING_SIZES[name])))
    values[index] = wrong
    assert linear.engine.feed(encode("s" + name, struct.pack(layout, *values))) == b"errv"
    assert struct.unpack(layout, linear.ask("g" + name, size=SETTING_SIZES[name]))[index] == corrected
    assert linear.status().flags & 7 == ERRV


def test_settings_survive_a_power_cycle_only_when_saved(linear: Bench) -> None:
    linear.change("mov", "<IBHHIBB9x", f0=700)
    linear.ask("save")
    linear.change("mov", "<IBHHIBB9x", f0=800)
    linear.axis.power_cycle()
    assert linear.ask("gmov", size=30)[:4] == struct.pack("<I", 700)
    linear.change("mov", "<IBHHIBB9x", f0=800)
    linear.ask("read")
    assert linear.ask("gmov", size=30)[:4] == struct.pack("<I", 700)
