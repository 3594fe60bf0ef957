"""Register maps: checks at load time, codecs, block planning."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermostand.drivers.wires.modbus_unit import Block, Sample, decode, decode_blocks, encode, plan_blocks
from thermostand.drivers.wires.registers import Point, RegisterMap, load_register_map
from thermostand.foundation.documents import parse_document
from thermostand.foundation.errors import ConfigError

MAPS = Path(__file__).parents[2] / "configs" / "registers"

MAP = """
schema: regmap/1
vendor: none
model: bench
source: this test
transport: {kind: modbus-rtu, unit: 3}
points:
  pv: {address: 0x10, type: int16, scale: 0.1, unit: degC, poll: fast, bad_if: [broken]}
  output: {address: 0x11, type: int16, unit: "%", poll: fast, split: {positive: mv_heat, negative: mv_cool}}
  status: {address: 0x12, type: uint32, word_order: low_first, poll: fast, bits: {0: broken, 17: stop}}
commands:
  stop: {address: 0, value: 0x0101, confirm: {point: status, bit: stop, is: true}}
safe_state: [stop]
"""


def bench(text: str = MAP) -> RegisterMap:
    return parse_document(text, RegisterMap, "bench.yaml")


@pytest.mark.parametrize("file", sorted(MAPS.glob("*.yaml")), ids=lambda file: file.stem)
def test_every_installed_map_loads(file: Path) -> None:
    register_map = load_register_map(file)
    assert register_map.polled()
    assert all(
        block.count <= register_map.transport.max_read_words
        for block in plan_blocks(register_map, [*register_map.points])
    )


def test_the_replies_of_an_e5cc_poll_differ_in_length_so_that_a_shifted_one_shows() -> None:
    register_map = load_register_map(MAPS / "omron-e5cc.yaml")
    blocks = plan_blocks(register_map, register_map.polled())
    assert [(block.address, block.count) for block in blocks] == [(0x2000, 6), (0x2103, 1), (0x2406, 2)]


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("address: 0x11", "address: 0x10", "points pv and output overlap at holding 0x0010"),
        ("address: 0x11", "address: 0x13", "points output and status overlap at holding 0x0013"),
        ("poll: fast, bad_if", "pol: fast, bad_if", "points.pv.pol: unknown key"),
        ("bad_if: [broken]", "bad_if: [brokn]", "points.pv.bad_if: no bit brokn"),
        ("bit: stop", "bit: stopp", "commands.stop.confirm: no bit stopp in point status"),
        ("point: status", "point: statu", "commands.stop.confirm: no bit stop in point statu"),
        ("value: 0x0101", "value: 0x10101", "commands.stop.value: must be less than or equal to 65535"),
        ("safe_state: [stop]", "safe_state: [halt]", "no command halt"),
        ("17: stop", "32: stop", "points.status: a uint32 has no bits"),
        ("17: stop", "17: broken", "bit broken is named twice"),
        ("type: uint32", "type: int64", "points.status.type"),
        ("scale: 0.1", "scale: 0", "points.pv: scale must not be 0"),
        ("scale: 0.1", "scale: .inf", "points.pv.scale"),
        ("address: 0x12", "address: 0xFFFF", "points.status: runs past address 0xFFFF"),
        ("address: 0x12", "space: coil, address: 0x12", "points.status: type uint32 cannot live in space coil"),
        ("scale: 0.1", "limits: [0, 1]", "points.pv: limits, pulse, eeprom and refresh need access: rw"),
        ("scale: 0.1", "valid: [9, 1]", "points.pv: valid must be"),
        ("positive: mv_heat", "positive: pv", "split pv is also a point"),
        ("unit: 3", "unit: 0", "transport.unit"),
    ],
)
def test_a_faulty_map_is_refused_with_file_path_and_reason(old: str, new: str, complaint: str) -> None:
    assert old in MAP
    with pytest.raises(ConfigError) as caught:
        bench(MAP.replace(old, new))
    assert str(caught.value).startswith("bench.yaml: ")
    assert complaint in str(caught.value)


@pytest.mark.parametrize(
    ("point", "words", "value"),
    [
        (Point(address=0, type="int16", scale=0.1), [0xFF9C], -10.0),
        (Point(address=0, type="uint16", scale=200 / 65535, offset=-50.0), [26874], 32.0142),  # ADAM-4015, type 0x20
        (Point(address=0, type="int16", scale=100 / 32767), [0x2000], 25.0008),  # M-7015, +-100 degC
        (Point(address=0, type="int32"), [0xFFFF, 0xFFFE], -2.0),
        (Point(address=0, type="uint32", word_order="low_first"), [0x0001, 0x0200], 0x02000001),
        (Point(address=0, type="float32"), [0x41CB, 0x70A4], 25.43),
        (Point(address=0, type="float32", word_order="low_first"), [0x70A4, 0x41CB], 25.43),
    ],
)
def test_words_decode_to_values_worked_out_by_hand(point: Point, words: list[int], value: float) -> None:
    assert decode(point, words).value == pytest.approx(value, abs=1e-4)


def test_fault_words_and_values_outside_valid_are_no_measurement() -> None:
    point = Point.model_validate(
        {
            "address": 0,
            "type": "int16",
            "scale": 0.1,
            "unit": "degC",
            "valid": [-20, 90],
            "faults": [{"raw": 0x7FFF, "code": "open"}],
        }
    )
    assert decode(point, [0x7FFF]).reason == "open"
    assert decode(point, [901]).reason == "90.1 degC is outside -20..90"
    assert decode(point, [900]) == Sample(900, 90.0)
    assert math.isnan(decode(point, [901]).value)
    assert decode(Point(address=0, type="float32"), [0x7FC0, 0]).reason == "not a number"


def test_bits_bad_if_and_split_are_read_out_of_the_blocks_of_one_poll() -> None:
    register_map = bench()
    (block,) = plan_blocks(register_map, register_map.polled())
    assert block == Block("holding", 0x10, 4, ("pv", "output", "status"))
    snapshot = decode_blocks(register_map, {block: [250, 0xFFCE, 0, 2]})
    assert snapshot.bits == {"broken": False, "stop": True}
    assert snapshot.samples["pv"].value == 25.0
    assert (snapshot.samples["mv_heat"].value, snapshot.samples["mv_cool"].value) == (0.0, 50.0)
    broken = decode_blocks(register_map, {block: [250, 0, 1, 0]})
    assert broken.samples["pv"].reason == "broken"
    assert math.isnan(broken.samples["pv"].value)


@pytest.mark.parametrize(
    ("addresses", "max_words", "expected"),
    [
        ([0, 5], 32, [(0, 6)]),  # a gap of four words is read along
        ([0, 6], 32, [(0, 1), (6, 1)]),
        ([0, 1, 2, 3], 2, [(0, 2), (2, 2)]),
        ([7, 3, 5], 32, [(3, 5)]),
    ],
)
def test_blocks_join_over_small_gaps_and_keep_to_the_maximum(
    addresses: list[int], max_words: int, expected: list[tuple[int, int]]
) -> None:
    head = MAP[: MAP.index("points:")].replace("unit: 3", f"unit: 3, max_read_words: {max_words}")
    text = head + "points:\n" + "".join(f"  p{address}: {{address: {address}}}\n" for address in addresses)
    register_map = bench(text)
    assert [(block.address, block.count) for block in plan_blocks(register_map, register_map.points)] == expected


@pytest.mark.parametrize(
    ("value", "complaint"),
    [(70.1, "outside the limits"), (-10.1, "outside the limits"), (math.nan, "outside the limits")],
)
def test_a_value_outside_the_limits_is_not_encoded(value: float, complaint: str) -> None:
    point = Point(address=0, type="int16", scale=0.1, access="rw", limits=(-10, 70))
    with pytest.raises(ValueError, match=complaint):
        encode(point, value)
    assert encode(point, -10.0) == [0xFF9C]


def test_what_does_not_fit_or_is_read_only_is_not_encoded() -> None:
    with pytest.raises(ValueError, match="does not fit int16"):
        encode(Point(address=0, type="int16", scale=0.1, access="rw"), 3276.8)
    with pytest.raises(ValueError, match="not a writable register"):
        encode(Point(address=0), 1)
    with pytest.raises(ValueError, match="cannot be written"):
        encode(Point(address=0, type="float32", access="rw"), math.inf)


@given(
    kind=st.sampled_from(["int16", "uint16", "int32", "uint32"]),
    order=st.sampled_from(["high_first", "low_first"]),
    scale=st.sampled_from([1.0, 0.1, 0.01, 100 / 32767, -0.5]),
    offset=st.sampled_from([0.0, -50.0]),
    words=st.lists(st.integers(0, 0xFFFF), min_size=2, max_size=2),
)
def test_every_word_survives_decoding_and_encoding(
    kind: str, order: str, scale: float, offset: float, words: list[int]
) -> None:
    point = Point.model_validate(
        {"address": 0, "type": kind, "word_order": order, "scale": scale, "offset": offset, "access": "rw"}
    )
    words = words[: point.words]
    assert encode(point, decode(point, words).value) == words


def test_a_map_can_be_used_for_a_unit_at_another_address() -> None:
    assert bench().at_unit(17).transport.unit == 17
    with pytest.raises(ValueError, match="247"):
        bench().at_unit(300)
