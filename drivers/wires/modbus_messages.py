"""Messages of Modbus as pymodbus has them, but for what it takes that the standard does not allow."""

from __future__ import annotations

import struct

from pymodbus.exceptions import ModbusException
from pymodbus.pdu import DecodePDU, ModbusPDU
from pymodbus.pdu.bit_message import (
    ReadCoilsRequest,
    ReadCoilsResponse,
    ReadDiscreteInputsRequest,
    ReadDiscreteInputsResponse,
)
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadHoldingRegistersResponse,
    ReadInputRegistersRequest,
    ReadInputRegistersResponse,
    WriteMultipleRegistersResponse,
)

from thermostand.drivers.wires.registers import Space

READS: dict[Space, type[ModbusPDU]] = {
    "holding": ReadHoldingRegistersRequest,
    "input": ReadInputRegistersRequest,
    "coil": ReadCoilsRequest,
    "discrete": ReadDiscreteInputsRequest,
}
_ADDRESS_AND_COUNT = 4  # bytes


class WriteCoilWord(ModbusPDU):
    """FC 05 with any 16-bit value, as request and reply (pymodbus knows FF00 and 0000 only).

    The Waveshare relay takes a time in the value (protocol V2, "flash on").
    """

    function_code = 5
    rtu_frame_size = 8

    def encode(self) -> bytes:
        """Address and value, big endian."""
        return struct.pack(">HH", self.address, self.registers[0])

    def decode(self, data: bytes) -> None:
        """The echo of address and value."""
        self.address, value = struct.unpack(">HH", data[:4])
        self.registers = [value]


def _make_strict(reply: type[ModbusPDU]) -> type[ModbusPDU]:
    """`reply` with a byte count that must be that of its data: pymodbus takes bits whatever it says, and registers with
    one byte too many, one after the other."""
    has_words = reply in (ReadHoldingRegistersResponse, ReadInputRegistersResponse)

    def decode(self: ModbusPDU, data: bytes) -> None:
        if data[0] != len(data) - 1:
            raise ValueError(f"byte count {data[0]} before {len(data) - 1} bytes")
        if has_words:
            self.registers = list(struct.unpack(f">{data[0] // 2}H", data[1:]))  # struct.error with half a word
        else:
            reply.decode(self, data)

    return type(reply.__name__, (reply,), {"decode": decode})


class _RegistersWritten(WriteMultipleRegistersResponse):
    """FC 16, whose reply is address and count and nothing else."""

    def decode(self, data: bytes) -> None:
        """ValueError when something follows."""
        if len(data) != _ADDRESS_AND_COUNT:
            raise ValueError(f"{len(data)} bytes of address and count")
        super().decode(data)


REPLIES = (
    WriteCoilWord,
    _RegistersWritten,
    *map(
        _make_strict,
        (ReadCoilsResponse, ReadDiscreteInputsResponse, ReadHoldingRegistersResponse, ReadInputRegistersResponse),
    ),
)

_REPLY_OF = {reply.function_code: reply for reply in REPLIES}


class Decoder(DecodePDU):
    """pymodbus' own, without its log: that writes each reply as text, also where nobody reads it."""

    def decode(self, frame: bytes) -> ModbusPDU | None:
        """A reply's message; None when it cannot be one."""
        reply = _REPLY_OF.get(frame[0])
        if reply is None:  # an exception, or nothing that was asked for
            return super().decode(frame)
        message = reply()
        try:
            message.decode(frame[1:])
        except (ModbusException, ValueError, IndexError, struct.error):
            return None
        return message
