import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.sim.gvcp_client import decode_ack, pack_read_memory, pack_words
from thermostand.drivers.sim.gige import gvcp
from thermostand.drivers.sim.gige.gvcp import Ack, GvcpCommand, GvcpRequest, GvcpStatus, Malformed, Nack, Resend

# One line per datagram: the bytes, and what they mean. The same table serves encoder and decoder.
REQUESTS = [
    ("42 01 0002 0000 ffff", GvcpRequest(GvcpCommand.DISCOVERY, 0xFFFF)),
    ("42 01 0080 0004 0001 00000a00", GvcpRequest(GvcpCommand.READREG, 1, pack_words([0x0A00]))),
    ("42 01 0082 0008 0002 00000a00 00000002", GvcpRequest(GvcpCommand.WRITEREG, 2, pack_words([0x0A00, 2]))),
    ("42 01 0084 0008 0003 00000200 0000 0200", GvcpRequest(GvcpCommand.READMEM, 3, pack_read_memory(0x200, 512))),
    (
        "42 01 0086 000c 0004 00010238 40d3880000000000",
        GvcpRequest(GvcpCommand.WRITEMEM, 4, gvcp.pack_write_memory(0x10238, bytes.fromhex("40d3880000000000"))),
    ),
    ("42 00 0040 000c 0005 0000 0007 00000003 00000009", Resend(7, 3, 9).request(5)),
    (
        "42 10 0040 0014 0006 0000 0000 00000003 00000009 0000000100000000",
        Resend(1 << 32, 3, 9, extended=True).request(6),
    ),
]
ACKS = [
    ("0000 0081 0004 0001 00000002", Ack(GvcpCommand.READREG, 1, pack_words([2]))),
    ("0000 0083 0004 0002 0000 0001", Ack(GvcpCommand.WRITEREG, 2, gvcp.pack_written(1))),
    ("8006 0083 0000 0003", Ack(GvcpCommand.WRITEREG, 3, status=GvcpStatus.ACCESS_DENIED)),
]


@pytest.mark.parametrize(("wire", "request_"), REQUESTS)
def test_a_command_is_these_bytes_and_back_even_with_bytes_behind_it(wire: str, request_: GvcpRequest) -> None:
    datagram = bytes.fromhex(wire)
    assert request_.encode() == datagram
    assert gvcp.decode_request(datagram) == request_
    assert gvcp.decode_request(datagram + b"trailing") == request_


@pytest.mark.parametrize(("wire", "ack"), ACKS)
def test_an_acknowledge_is_these_bytes(wire: str, ack: Ack) -> None:
    assert ack.encode() == bytes.fromhex(wire)
    assert decode_ack(bytes.fromhex(wire)) == ack


@pytest.mark.parametrize("wire", [wire for wire, _ in REQUESTS])
def test_a_command_cut_short_anywhere_is_malformed(wire: str) -> None:
    datagram = bytes.fromhex(wire)
    for length in range(len(datagram)):
        with pytest.raises(Malformed):
            gvcp.decode_request(datagram[:length])


def test_a_command_whose_acknowledge_has_no_code_is_malformed() -> None:
    """An acknowledge is its command plus 1, in 16 bits."""
    with pytest.raises(Malformed, match="no acknowledge can answer"):
        gvcp.decode_request(GvcpRequest(0xFFFF, 1).encode())


def test_a_wrong_key_is_malformed() -> None:
    with pytest.raises(Malformed, match="key"):
        gvcp.decode_request(bytes.fromhex("43 01 0002 0000 ffff"))


@pytest.mark.parametrize(
    ("address", "count", "status"),
    [
        (0, 0, GvcpStatus.BAD_PARAMETER),
        (0, 516, GvcpStatus.BAD_PARAMETER),
        (2, 4, GvcpStatus.BAD_ALIGNMENT),
        (0, 3, GvcpStatus.BAD_ALIGNMENT),
    ],
)
def test_readmem_takes_1_to_128_whole_words(address: int, count: int, status: GvcpStatus) -> None:
    with pytest.raises(Nack) as refused:
        gvcp.unpack_read_memory(pack_read_memory(address, count))
    assert refused.value.status == status


@pytest.mark.parametrize("payload", [b"", b"\0", bytes(7)])
def test_payloads_of_no_whole_words_are_refused(payload: bytes) -> None:
    for unpack in (gvcp.unpack_words, gvcp.unpack_read_memory, gvcp.unpack_write_memory):
        with pytest.raises(Nack):
            unpack(payload)


def test_a_short_packet_resend_is_refused() -> None:
    whole = Resend(1, 2, 3, extended=True).request(1)
    with pytest.raises(Nack):
        gvcp.unpack_resend(GvcpRequest(whole.command, 1, whole.payload[:-1], whole.flags))


u16 = st.integers(0, 0xFFFF)
u24 = st.integers(0, 0xFFFFFF)
u32 = st.integers(0, 0xFFFFFFFF)
payloads = st.binary(max_size=540)


@given(st.integers(0, 0xFFFE), u16, payloads, st.integers(0, 255))
def test_any_command_survives_the_round_trip(command: int, req_id: int, payload: bytes, flags: int) -> None:
    request = GvcpRequest(command, req_id, payload, flags)
    assert gvcp.decode_request(request.encode()) == request


@given(
    st.one_of(st.builds(Resend, u16, u24, u24), st.builds(Resend, st.integers(0, 2**64 - 1), u32, u32, st.just(True)))
)
def test_any_packet_resend_survives_the_round_trip(resend: Resend) -> None:
    assert gvcp.unpack_resend(gvcp.decode_request(resend.request(1).encode())) == resend


@given(st.binary(max_size=64))
def test_noise_is_a_command_or_malformed_and_nothing_else(noise: bytes) -> None:
    try:
        request = gvcp.decode_request(noise)
    except Malformed:
        return
    assert noise.startswith(request.encode())
