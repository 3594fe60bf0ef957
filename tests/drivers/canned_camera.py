"""The fake camera's ends of GVCP and GVSP, on damaged datagrams."""

from __future__ import annotations

import struct

from tests.drivers.canned_line import Feed, Parser
from tests.sim.gvcp_client import decode_ack
from thermostand.drivers.sim.gige import gvcp
from thermostand.drivers.sim.gige.camera_registers import ControlChannel, Registers
from thermostand.drivers.sim.gige.genicam import make_features

_MEMORY, _MEMORY_SIZE = 0x10000, 0x400  # of the features
_PEER = ("127.0.0.1", 40001)
_GVCP = tuple(
    bytes.fromhex(line)
    for line in (
        "42 01 0082 0008 0002 00000a00 00000002",
        "42 01 0002 0000 ffff",
        "42 01 0080 0004 0001 00000a00",
        "42 01 0084 0008 0003 00000200 0000 0200",
        "42 01 0086 000c 0004 00010238 40d3880000000000",
        "42 00 0040 000c 0005 0000 0007 00000003 00000009",
        "42 10 0040 0014 0006 0000 0000 00000003 00000009 0000000100000000",
    )
)


class _Silent:
    """A device behind the control protocol on which nothing has an effect."""

    def before_read(self, address: int, count: int) -> None: ...

    def after_write(self, name: str) -> None: ...

    def resend(self, resend: gvcp.Resend) -> None: ...

    def control_ended(self) -> None: ...


def gvcp_commands() -> Parser:
    def make() -> Feed:
        registers = Registers(make_features(64, 48, "SN1"), "127.0.0.71", "SN1")
        channel = ControlChannel(registers, _Silent())

        def feed(number: int, wire: bytes) -> bool:
            channel.forget()
            channel.feed(_GVCP[0], _PEER, 0.0)  # in control: writes are carried out
            memory = registers.read(_MEMORY, _MEMORY_SIZE)
            answer = channel.feed(wire, _PEER, 0.0)
            if registers.read(_MEMORY, _MEMORY_SIZE) != memory:
                assert wire[2:4] in (b"\x00\x82", b"\x00\x86"), "written by another command than a write"
                registers.reset()
            if not answer:
                return wire[2:4] == b"\x00\x40"
            ack = decode_ack(answer)
            assert (ack.command, ack.req_id) == struct.unpack_from(">H2xH", wire, 2)
            assert ack.status == gvcp.GvcpStatus.OK or ack.payload == b""
            return ack.status == gvcp.GvcpStatus.OK

        return feed

    return Parser(_GVCP, make)
