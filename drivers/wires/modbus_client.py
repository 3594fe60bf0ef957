"""The one place that drives pymodbus: a blocking master, one request and its checked reply, failures as WireFaults.

pymodbus changes its interface in minor releases, and polls a serial port in steps of four characters (5 ms at 9600
baud); the subclasses here wait for the first byte instead and say why a port does not open.
"""

from __future__ import annotations

import logging
import math
import select
import socket
import struct
import termios
import time
from collections.abc import Sequence
from enum import StrEnum
from typing import Literal

import serial
from pydantic import Field
from pymodbus.client import ModbusSerialClient, ModbusTcpClient
from pymodbus.exceptions import ConnectionException, ModbusException, ModbusIOException
from pymodbus.framer.rtu import FramerRTU
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
    WriteMultipleRegistersRequest,
    WriteMultipleRegistersResponse,
    WriteSingleRegisterRequest,
)

from thermostand.drivers.wires.link import CLOSING_S, DELIVERY_S, HangUps, explain_closed
from thermostand.drivers.wires.registers import Space
from thermostand.foundation.addresses import (
    ByteAddress,
    SerialEndpoint,
    TcpEndpoint,
    get_display_address,
    parse_address,
)
from thermostand.foundation.clock import Now, VirtualClock, await_simulated_answers
from thermostand.foundation.documents import Document

# Messages of Modbus as pymodbus has them, but for what it takes that the standard does not allow.

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


# Every fault is raised and counted here; pymodbus would print it a second time on stderr.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)

EXCEPTIONS = {
    1: "illegal function",
    2: "illegal address",
    3: "illegal value",
    4: "device failure",
    5: "acknowledge, still working",
    6: "busy",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "no answer behind the gateway",
}
_EXCEPTION = 0x80  # of the function in a reply
_SHORTEST_RTU = 4  # bytes of a frame, and more
RTU_OVER_TCP = (
    "the reply is a frame of Modbus RTU, and tcp: is Modbus TCP: set the gateway to Modbus TCP (not transparent, not "
    "RTU over TCP), or make its line a serial port of this computer (by socat or its driver) and give serial:PATH"
)
_READS = frozenset({1, 2, 3, 4})
_HEAD = 7  # bytes before the function over TCP: number, protocol 0, length, unit
UNANSWERED_EXCEPTIONS = frozenset({6, 10, 11})  # somebody answered, but not the unit, or not now


class BusSettings(Document):
    """An RS-485 bus, by a serial adapter or behind a Modbus TCP gateway; every unit is set to the same line, which has
    8 data bits. Real seconds: timeout_s must exceed the slowest normal reply of any unit; gap_s is the silence between
    a reply and the next request on a serial line (a gateway keeps its own)."""

    address: ByteAddress
    baud: int = Field(default=9600, ge=1200, le=921600)
    parity: Literal["N", "E", "O"] = "N"
    stopbits: Literal[1, 2] = 1
    timeout_s: float = Field(default=0.3, gt=0, le=10)
    gap_s: float = Field(default=0.005, ge=0, le=1)


class FaultKind(StrEnum):
    """How a transaction failed."""

    LINE_DOWN = "line down"  # the port or connection itself: no unit is to blame
    SILENCE = "silence"
    GARBLED = "garbled"
    REFUSED = "refused"


class WireFault(Exception):
    """One transaction failed; `fault` says how, the text why."""

    def __init__(self, fault: FaultKind, text: str) -> None:
        super().__init__(text)
        self.fault = fault


class SerialClient(ModbusSerialClient):
    """pymodbus over pyserial, without its polling. clock: see ModbusClient."""

    clock: Now | None = None

    def connect(self) -> bool:
        """Open the port exclusively; raises OSError with the reason."""
        if self.socket is None:
            line = self.comm_params
            self.socket = serial.Serial(
                line.host,
                baudrate=line.baudrate or 9600,
                parity=line.parity or "N",
                stopbits=line.stopbits or 1,
                timeout=line.timeout_connect,
                write_timeout=line.timeout_connect,
                exclusive=True,
            )
            self.socket.reset_input_buffer()  # earlier bytes were not for us
        if isinstance(self.clock, VirtualClock):
            self.comm_params.timeout_connect = math.inf  # for the rest of a reply: `recv` knows when there is none
        return True

    def recv(self, size: int | None) -> bytes:
        """Wait for one byte, then take what has come; b"" after the time-out."""
        if self.socket is None:
            raise ConnectionException("port closed")
        first = self.socket.read(1)
        if not first and await_simulated_answers(self.clock):
            select.select([self.socket], [], [], DELIVERY_S)
            first = self.socket.read(min(1, self.socket.in_waiting))
        return first + self.socket.read(self.socket.in_waiting) if first else b""


class TcpClient(ModbusTcpClient):
    """pymodbus' messages and frames over TCP. The kernel keeps the time-out: a reply then costs one call of it instead
    of three. Without pymodbus' transactions, which repeat and look for echoes; neither is wanted here. clock: see
    ModbusClient."""

    number = 0  # of the last transaction
    clock: Now | None = None

    def execute(self, no_response_expected: bool, request: ModbusPDU) -> ModbusPDU:
        """The reply to one request, sent once; ModbusIOException when none comes within the time-out."""
        self.number = request.transaction_id = self.number % 0xFFFF + 1
        trace, timeout_s = self.transaction.trace_packet, self.comm_params.timeout_connect or 0.0
        # pymodbus' messages and frames without its transactions, which repeat, look for echoes and log: 11 us of a
        # register read for 16 to 19. What those checked, the unit and the number of the request, is checked below.
        packet = trace(True, self.framer.buildFrame(request))
        self.send(packet)
        # In virtual time `recv` knows when nothing comes any more.
        deadline_s = math.inf if isinstance(self.clock, VirtualClock) else time.monotonic() + timeout_s
        heard = b""
        while data := self.recv(None):
            heard = trace(False, heard + data)
            if foreign := _explain_foreign(packet, heard):
                raise WireFault(FaultKind.GARBLED, foreign)
            if _is_reply(packet, heard) and (reply := self.framer.decoder.decode(heard[_HEAD:])) is not None:
                return reply
            used, reply = self.framer.handleFrame(heard, request.dev_id, request.transaction_id)
            if reply is not None:
                return reply
            heard = heard[used:]
            if time.monotonic() >= deadline_s:
                break
        raise ModbusIOException("no reply in time")

    def connect(self) -> bool:
        """Connect; raises OSError with the reason."""
        if self.socket is None:
            peer = self.comm_params
            timeout_s = peer.timeout_connect or 0.0
            self.socket = socket.create_connection((peer.host, peer.port), timeout=timeout_s)
            self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.socket.settimeout(None)
            limit = struct.pack("@ll", *divmod(max(1, round(timeout_s * 1e6)), 1_000_000))  # 0 would be for ever
            # The kernel's own time-outs: no poll for each answer.
            for option in (socket.SO_RCVTIMEO, socket.SO_SNDTIMEO):
                self.socket.setsockopt(socket.SOL_SOCKET, option, limit)
        return True

    def is_closed(self, wait_s: float = 0.0) -> bool:
        """Return whether the peer has closed the connection, or does within that time: what is written into it is never
        sent."""
        try:
            if self.socket is not None and wait_s > 0:
                select.select([self.socket], [], [], wait_s)
            return self.socket is None or not self.socket.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
        except BlockingIOError:
            return False
        except OSError:
            return True

    def recv(self, size: int | None) -> bytes:
        """Return what has come; b"" after the time-out."""
        if self.socket is None:
            raise ConnectionException("connection closed")
        try:
            data = self._receive(self.socket)
        except BlockingIOError:
            return b""
        if not data:
            raise ConnectionException("the connection was closed")
        return data

    def _receive(self, opened: socket.socket) -> bytes:
        try:
            return opened.recv(4096)
        except BlockingIOError:
            if not await_simulated_answers(self.clock):
                raise
            return opened.recv(4096, socket.MSG_DONTWAIT)


def _is_reply(packet: bytes, heard: bytes) -> bool:
    """Return whether what was heard is one frame and no more, with the number and the unit of the request. Anything
    else is left to pymodbus, which takes twice as long to find its way through it."""
    is_whole = len(heard) > _HEAD and int.from_bytes(heard[4:6], "big") == len(heard) - 6
    return is_whole and heard[:4] == packet[:4] and heard[6] == packet[6]


def _explain_foreign(packet: bytes, heard: bytes) -> str:
    """Return why what was heard answers another request than this one, or is of another protocol; "" when it may be its
    reply."""
    is_rtu = heard[:4] != packet[:4] and heard[:1] == packet[6:7] and len(heard) > _SHORTEST_RTU
    if is_rtu and FramerRTU.compute_CRC(heard[:-2]) == int.from_bytes(heard[-2:], "big"):
        return RTU_OVER_TCP
    if len(heard) <= _HEAD or heard[2:4] != b"\0\0":
        return ""
    sent, returned = (int.from_bytes(each[:2], "big") for each in (packet, heard))
    if returned != sent:
        return f"the gateway returned transaction number {returned} for {sent}; is it set to Modbus TCP?"
    if heard[6] != packet[6]:
        return f"unit {heard[6]} answered where unit {packet[6]} was asked"
    return ""


class ModbusClient:
    """A blocking Modbus master on one line, for one thread. Bounded: a transaction ends within twice the time-out; in
    virtual time (`clock`) not before the simulated units have nothing left to answer."""

    def __init__(self, settings: BusSettings, clock: Now | None = None) -> None:
        self._settings = settings
        self._clock = clock
        self._place = parse_address(settings.address)
        self._where = get_display_address(settings.address)
        self.serial = isinstance(self._place, SerialEndpoint)
        self._client: SerialClient | TcpClient | None = None
        self.hang_ups = 0  # connections that the peer had closed before the next request
        self._manners = HangUps()
        self._sent = b""
        self._heard = b""
        self._reads: dict[tuple[int, Space, int, int], ModbusPDU] = {}  # a stand asks for the same again and again

    def connect(self) -> None:
        """Open the port or connection unless it is open; raises WireFault LINE_DOWN with the reason."""
        if self._client is not None:
            return
        client = self._make()
        client.clock = self._clock
        client.framer.decoder = Decoder(is_server=False)
        for reply in REPLIES:
            client.register(reply)
        try:
            client.connect()
        except (OSError, termios.error) as error:
            client.close()
            text = f"cannot open {self._where}: {explain_closed(error)}"
            raise WireFault(FaultKind.LINE_DOWN, text) from error
        self._client = client
        self._manners.opened()

    def _close_hung_up(self, request: ModbusPDU) -> None:
        """Let go of a connection that its gateway has closed. One that may close each after a reply is given a moment
        for it before the first write."""
        if not isinstance(self._client, TcpClient):
            return
        is_read = request.function_code in _READS
        if self._client.is_closed(0.0 if is_read or not self._manners.is_suspect else CLOSING_S):
            self._manners.note_close()
            self.hang_ups += 1
            self.close()

    def _make(self) -> SerialClient | TcpClient:
        settings, place = self._settings, self._place
        if isinstance(place, TcpEndpoint):
            return TcpClient(
                place.host, port=place.port, timeout=settings.timeout_s, retries=0, trace_packet=self._trace
            )
        return SerialClient(
            place.path,
            baudrate=settings.baud,
            parity=settings.parity,
            stopbits=settings.stopbits,
            timeout=settings.timeout_s,
            retries=0,
            trace_packet=self._trace,
        )

    def close(self) -> None:
        """Let go of the port or connection; never raises, may be called twice."""
        client, self._client = self._client, None
        if client is not None:
            client.close()

    def unread_bytes(self) -> int:
        """Bytes that came without a request; 0 over TCP, where transaction numbers expose them."""
        if not self.serial:
            return 0
        port = self._client.socket if self._client is not None else None
        try:
            return port.in_waiting if isinstance(port, serial.Serial) else 0
        except OSError:
            return 0  # unplugged: the request that follows says so

    def discard_input(self) -> None:
        """Forget all that has arrived: flush the port, or drop the connection (a late reply dies with it)."""
        port = self._client.socket if self._client is not None else None
        if not isinstance(port, serial.Serial):
            self.close()
            return
        try:
            port.reset_input_buffer()
        except (OSError, termios.error):
            self.close()

    def read(self, unit: int, space: Space, address: int, count: int) -> list[int]:
        """`count` registers or bits (0 or 1) from `address` on."""
        request = self._reads.get((unit, space, address, count))
        if request is None:
            request = READS[space](dev_id=unit, address=address, count=count)
            self._reads[unit, space, address, count] = request
        reply = self._exchange(request)
        if self.serial and self._heard.startswith(self._sent):
            raise WireFault(FaultKind.GARBLED, "the request came back (local echo of the adapter?)")
        if space in ("holding", "input"):
            return _check_length(list(reply.registers), count, count)
        return _check_length([int(bit) for bit in reply.bits], -(-count // 8) * 8, count)

    def write_register(self, unit: int, address: int, value: int) -> None:
        """FC 06."""
        self._send_single_write(WriteSingleRegisterRequest(dev_id=unit, address=address, registers=[value]))

    def write_coil(self, unit: int, address: int, raw_value: int) -> None:
        """FC 05 with any 16-bit value."""
        self._send_single_write(WriteCoilWord(dev_id=unit, address=address, registers=[raw_value]))

    def write_registers(self, unit: int, address: int, values: Sequence[int]) -> None:
        """FC 16."""
        reply = self._exchange(WriteMultipleRegistersRequest(dev_id=unit, address=address, registers=values))
        if (reply.address, reply.count) != (address, len(values)):
            raise WireFault(
                FaultKind.GARBLED,
                f"wrote {len(values)} words at {address:#06x}, the reply has {reply.count} at {reply.address:#06x}",
            )

    def _send_single_write(self, request: ModbusPDU) -> None:
        """Send a single write, whose reply repeats address and value, and so is as long as the request."""
        reply = self._exchange(request)
        if len(self._heard) != len(self._sent):
            raise WireFault(FaultKind.GARBLED, "more came back than a reply (local echo of the adapter?)")
        sent, echoed = ((pdu.address, pdu.registers[0]) for pdu in (request, reply))
        if sent != echoed:
            raise WireFault(
                FaultKind.GARBLED,
                "wrote {1:#06x} at {0:#06x}, the reply has {3:#06x} at {2:#06x}".format(*sent, *echoed),
            )

    def _exchange(self, request: ModbusPDU) -> ModbusPDU:
        """Send `request`; its reply, of the same function and unit; raises WireFault."""
        self._close_hung_up(request)
        self.connect()
        reply = self._execute(request)
        self._manners.answered()
        if self._manners.is_known and not self.serial:
            self.close()  # the gateway is about to, and the next request is not to meet that
        if reply.function_code & 0x7F != request.function_code:
            raise WireFault(FaultKind.GARBLED, f"asked function {request.function_code}, got {reply.function_code}")
        if reply.function_code & _EXCEPTION:
            code = reply.exception_code
            fault = FaultKind.SILENCE if code in UNANSWERED_EXCEPTIONS else FaultKind.REFUSED
            raise WireFault(fault, f"exception {code} ({EXCEPTIONS.get(code, 'not in the standard')})")
        return reply

    def _execute(self, request: ModbusPDU) -> ModbusPDU:
        client = self._client
        if client is None:
            raise WireFault(FaultKind.LINE_DOWN, f"{self._where} is closed")
        self._heard = b""
        try:
            return client.execute(False, request)
        except ConnectionException as error:
            self.close()
            raise WireFault(FaultKind.LINE_DOWN, f"{self._where} is gone: {error.string}") from error
        except ModbusException as error:
            if self._heard:
                raise WireFault(FaultKind.GARBLED, f"no valid reply in {self._heard.hex(' ')}") from error
            raise WireFault(FaultKind.SILENCE, f"no reply within {self._settings.timeout_s:g} s") from error
        except (OSError, termios.error) as error:
            self.close()
            raise WireFault(FaultKind.LINE_DOWN, f"{self._where} is gone: {error}") from error

    def _trace(self, sending: bool, data: bytes) -> bytes:
        """pymodbus hands every packet here: what went out, and what has come and is not yet a frame."""
        if sending:
            self._sent = data
        else:
            self._heard = data
        return data


def _check_length(values: list[int], expected: int, count: int) -> list[int]:
    """The first `count` of `values`, of which there must be `expected`: another length answers another request."""
    if len(values) != expected:
        raise WireFault(FaultKind.GARBLED, f"asked for {count} values, got {len(values)}")
    return values[:count]
