import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.sim.gvcp_client import decode_leader, decode_packet
from thermostand.drivers.sim.gige import gvsp
from thermostand.drivers.sim.gige.gvsp import ImageBlock, Leader, PacketKind, PixelFormat

LEADER = Leader(0x0102030405060708, PixelFormat.MONO8, 64, 48, 4, 2)
LEADER_BYTES = bytes.fromhex("0000 0001 0102030405060708 01080001 00000040 00000030 00000004 00000002 0000 0000")


@pytest.mark.parametrize(
    ("wire", "kind", "block_id", "packet_id", "status", "extended"),
    [
        ("0000 0001 01000000", PacketKind.LEADER, 1, 0, gvsp.OK, False),
        ("0000 ffff 03000005", PacketKind.PAYLOAD, 0xFFFF, 5, gvsp.OK, False),
        ("0100 0002 02000009", PacketKind.TRAILER, 2, 9, gvsp.RESENT, False),
        ("0000 0000 83000000 0000000100000002 01020304", PacketKind.PAYLOAD, (1 << 32) + 2, 0x01020304, gvsp.OK, True),
    ],
)
def test_the_header_is_these_bytes(
    wire: str, kind: PacketKind, block_id: int, packet_id: int, status: int, extended: bool
) -> None:
    assert gvsp.make_header(kind, block_id, packet_id, status, extended) == bytes.fromhex(wire)


def test_the_leader_is_these_36_bytes() -> None:
    assert LEADER.encode() == LEADER_BYTES
    assert decode_leader(LEADER_BYTES) == LEADER


def block_of(pixels: bytes, packet_size: int, extended: bool) -> ImageBlock:
    return ImageBlock(7, LEADER, memoryview(pixels), packet_size, extended)


def test_a_full_frame_at_8000_bytes_takes_630_payload_packets() -> None:
    block = block_of(bytes(2448 * 2048), 8000, extended=False)
    assert block.data_size == 7964
    assert block.trailer_id == 631


@pytest.mark.parametrize("packet_id", [-1, 4])
def test_a_block_has_no_packets_beyond_its_trailer(packet_id: int) -> None:
    block = block_of(bytes(300), 220, extended=False)
    assert block.trailer_id == 3
    with pytest.raises(IndexError):
        block.packet(packet_id)


def test_the_trailer_tells_the_number_of_lines() -> None:
    block = block_of(bytes(300), 220, extended=False)
    head, data = block.packet(3, gvsp.RESENT)
    assert head + data == bytes.fromhex("0100 0007 02000003 0000 0001 00000030")


@given(st.binary(min_size=1, max_size=3000), st.integers(220, 1500), st.booleans())
def test_any_block_is_whole_again_after_the_wire(pixels: bytes, packet_size: int, extended: bool) -> None:
    block = block_of(pixels, packet_size, extended)
    packets = [decode_packet(b"".join(block.packet(packet_id))) for packet_id in range(block.trailer_id + 1)]
    leader, *payload, trailer = packets
    assert (leader.kind, trailer.kind) == (PacketKind.LEADER, PacketKind.TRAILER)
    assert decode_leader(leader.data) == LEADER
    assert [packet.packet_id for packet in payload] == list(range(1, len(payload) + 1))
    assert {packet.kind for packet in payload} == {PacketKind.PAYLOAD}
    assert {len(packet.data) for packet in payload[:-1]} <= {block.data_size}
    assert b"".join(packet.data for packet in payload) == pixels
