import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.sim.gvcp_client import decode_leader
from thermostand.drivers.sim.gige import gvsp
from thermostand.drivers.sim.gige.gvsp import ImageBlock, Leader, Malformed, Packet, PacketKind, PixelFormat

PACKETS = [
    ("0000 0001 01000000", Packet(PacketKind.LEADER, 1, 0)),
    ("0000 ffff 03000005 aabb", Packet(PacketKind.PAYLOAD, 0xFFFF, 5, b"\xaa\xbb")),
    ("0100 0002 02000009", Packet(PacketKind.TRAILER, 2, 9, status=gvsp.RESENT)),
    (
        "0000 0000 83000000 0000000100000002 01020304 cc",
        Packet(PacketKind.PAYLOAD, (1 << 32) + 2, 0x01020304, b"\xcc", extended=True),
    ),
]
LEADER = Leader(0x0102030405060708, PixelFormat.MONO8, 64, 48, 4, 2)
LEADER_BYTES = bytes.fromhex("0000 0001 0102030405060708 01080001 00000040 00000030 00000004 00000002 0000 0000")


@pytest.mark.parametrize(("wire", "packet"), PACKETS)
def test_a_packet_is_these_bytes_and_back(wire: str, packet: Packet) -> None:
    assert packet.encode() == bytes.fromhex(wire)
    assert gvsp.decode(bytes.fromhex(wire)) == packet


def test_bytes_behind_the_header_are_the_data() -> None:
    datagram = bytes.fromhex(PACKETS[0][0])
    assert gvsp.decode(datagram + b"trailing").data == b"trailing"


@pytest.mark.parametrize(("wire", "packet"), PACKETS)
def test_a_header_cut_short_anywhere_is_malformed(wire: str, packet: Packet) -> None:
    datagram = bytes.fromhex(wire)
    for length in range(gvsp.header_size(packet.extended)):
        with pytest.raises(Malformed):
            gvsp.decode(datagram[:length])


def test_a_packet_of_unknown_kind_is_malformed() -> None:
    with pytest.raises(Malformed, match="kind 4"):
        gvsp.decode(bytes.fromhex("0000 0001 04000000"))


def test_the_leader_is_these_36_bytes_and_back() -> None:
    assert LEADER.encode() == LEADER_BYTES
    assert decode_leader(LEADER_BYTES + b"trailing") == LEADER
    for length in range(len(LEADER_BYTES)):
        with pytest.raises(Malformed):
            decode_leader(LEADER_BYTES[:length])


def test_a_leader_of_something_else_than_an_image_is_malformed() -> None:
    with pytest.raises(Malformed, match="type"):
        decode_leader(b"\0\0\0\4" + LEADER_BYTES[4:])


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
    packets = [gvsp.decode(b"".join(block.packet(packet_id))) for packet_id in range(block.trailer_id + 1)]
    leader, *payload, trailer = packets
    assert (leader.kind, trailer.kind) == (PacketKind.LEADER, PacketKind.TRAILER)
    assert decode_leader(leader.data) == LEADER
    assert [packet.packet_id for packet in payload] == list(range(1, len(payload) + 1))
    assert {packet.kind for packet in payload} == {PacketKind.PAYLOAD}
    assert {len(packet.data) for packet in payload[:-1]} <= {block.data_size}
    assert b"".join(packet.data for packet in payload) == pixels


@given(
    st.builds(
        Packet,
        st.sampled_from(PacketKind),
        st.integers(0, 0xFFFF),
        st.integers(0, 0xFFFFFF),
        st.binary(max_size=50),
        st.integers(0, 0xFFFF),
    )
)
def test_any_packet_survives_the_round_trip(packet: Packet) -> None:
    assert gvsp.decode(packet.encode()) == packet


@given(st.binary(max_size=64))
def test_noise_is_a_packet_or_malformed_and_nothing_else(noise: bytes) -> None:
    try:
        packet = gvsp.decode(noise)
    except Malformed:
        return
    assert noise.endswith(packet.data)
