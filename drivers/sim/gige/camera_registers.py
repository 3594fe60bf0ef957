"""The camera's memory: bootstrap block, feature registers and XML, with the rules of every write."""

from __future__ import annotations

import ipaddress
import struct
import zlib
from typing import Protocol

from thermostand.drivers.sim.gige import gvcp
from thermostand.drivers.sim.gige.genicam import XML_ADDRESS, XML_NAME, Feature, to_xml
from thermostand.drivers.sim.gige.gvcp import Ack, GvcpCommand, GvcpRequest, GvcpStatus, Nack, Resend

CAN_CONCATENATE, CAN_WRITE_MEMORY, CAN_RESEND, CAN_PEND = 1 << 0, 1 << 1, 1 << 2, 1 << 5
HAS_USER_NAME, HAS_SERIAL = 1 << 31, 1 << 30
DISCOVERY_bytes = 0xF8

_CAPABILITY = 0x0934
_STREAM_CHANNELS = 0x0904
BOOTSTRAP_bytes = 0x1000
_NUMBER_bytes = 8
_FEATURES_ADDRESS = 0x10000


class Registers:
    """Big-endian memory laid out by the feature table; reads and writes as GVCP asks for them raise Nack.

    `xml` at `xml_address` is what a client reads as the camera's description, the table's own by default.
    """

    def __init__(
        self,
        table: tuple[Feature, ...],
        address: str,
        serial: str,
        xml: bytes = b"",
        xml_address: int = XML_ADDRESS,
    ) -> None:
        self._table = {feature.name: feature for feature in table}
        self._at: dict[int, list[Feature]] = {}
        for feature in table:
            self._at.setdefault(feature.address, []).append(feature)
        self._xml, self._xml_address = xml or to_xml(table), xml_address
        xml_padded = self._xml + bytes(-len(self._xml) % 4)  # clients read whole words
        self._segments = {
            0: bytearray(BOOTSTRAP_bytes),
            _FEATURES_ADDRESS: bytearray(0x400),
            xml_address: bytearray(xml_padded),
        }
        self._write_bootstrap(address, serial)
        self.reset()

    def _write_bootstrap(self, address: str, serial: str) -> None:
        mac = 0x02_00_00_00_00_00 | zlib.crc32(serial.encode())  # locally administered, the same in every run
        words = {
            0x0000: 0x00010002,  # GigE Vision 1.2
            0x0004: 0x80000001,  # big endian, UTF-8
            0x0008: mac >> 32,
            0x000C: mac & 0xFFFFFFFF,
            0x0010: 0x5,  # persistent IP and link-local are possible
            0x0014: 0x5,
            0x0024: int(ipaddress.IPv4Address(address)),
            0x0034: 0xFF000000,
            0x0600: 1,  # network interfaces
            _STREAM_CHANNELS: 1,
        }
        for offset, word in words.items():
            struct.pack_into(">I", self._segments[0], offset, word)
        self._standing = dict.fromkeys((*words, _CAPABILITY), 4)
        url = f"Local:{XML_NAME};{self._xml_address:X};{len(self._xml):X}".encode()
        self._segments[0][0x0200 : 0x0200 + len(url)] = url
        self.offer_resend(True)

    def offer_resend(self, offered: bool) -> None:
        """Set the capability register, with or without PACKETRESEND."""
        capability = (
            CAN_CONCATENATE | CAN_WRITE_MEMORY | CAN_PEND | HAS_USER_NAME | HAS_SERIAL | (CAN_RESEND if offered else 0)
        )
        struct.pack_into(">I", self._segments[0], _CAPABILITY, capability)

    def offer_stream(self, offered: bool) -> None:
        """Set the count of stream channels, 1 or 0."""
        struct.pack_into(">I", self._segments[0], _STREAM_CHANNELS, int(offered))

    def reset(self) -> None:
        """Every feature to its default, as after power-on."""
        for feature in self._table.values():
            if isinstance(feature.default, str):
                data = feature.default.encode()[: feature.length].ljust(feature.length, b"\0")
                self._store(feature.address, data)
            elif feature.kind != "command":
                self.put(feature.name, feature.default)

    def is_bootstrap(self, address: int, count: int) -> bool:
        """Return whether a bootstrap register lies there that says something; texts, such as the description's URL, are
        read whole and not by 4 or 8 bytes."""
        if count > _NUMBER_bytes:
            return address < BOOTSTRAP_bytes
        features = {at: fields[0].length for at, fields in self._at.items() if at < BOOTSTRAP_bytes}
        places = self._standing | features
        return any(address < begin + length and begin < address + count for begin, length in places.items())

    # ------------------------------------------------------------------------------------------ seen from the camera

    def integer(self, name: str) -> int:
        """The value of an integer, enumeration or boolean feature."""
        feature = self._table[name]
        return _extract_field(feature, int.from_bytes(self._load(feature.address, feature.length), "big"))

    @property
    def binning(self) -> tuple[int, int]:
        """How many pixels of the sensor, across and down, make one of the image."""
        return 1, 1

    def real(self, name: str) -> float:
        """The value of a float feature."""
        (value,) = struct.unpack(">d", self._load(self._table[name].address, 8))
        return value

    def put(self, name: str, value: float) -> None:
        """Set a feature from inside: no access rules."""
        feature = self._table[name]
        if feature.kind == "float":
            self._store(feature.address, struct.pack(">d", value))
            return
        word = int.from_bytes(self._load(feature.address, feature.length), "big")
        word = word & ~(get_largest(feature) << feature.lsb) | int(value) << feature.lsb
        self._store(feature.address, word.to_bytes(feature.length, "big"))

    def covers(self, name: str, address: int, count: int) -> bool:
        """Return whether a read of `count` bytes at `address` touches the feature's register."""
        feature = self._table[name]
        return address < feature.address + feature.length and feature.address < address + count

    # -------------------------------------------------------------------------------------------- seen from the wire

    def read(self, address: int, count: int) -> bytes:
        """`count` bytes from `address`; Nack outside the memory."""
        return self._load(address, count)

    def write(self, address: int, data: bytes) -> tuple[str, ...]:
        """Write one whole register; the names of the features that changed and the commands that were given.

        Nothing is written when any field is refused: unknown, read only, locked, or out of range.
        """
        fields = self._at.get(address, [])
        if not fields:
            self._find(address, len(data))
            raise Nack(GvcpStatus.WRITE_PROTECT, f"no register to write at {address:#x}")
        if any(feature.access == "RO" for feature in fields):
            raise Nack(GvcpStatus.WRITE_PROTECT, f"{fields[0].name} is read only")
        if fields[0].kind == "string":
            return self._write_text(fields[0], data)
        if len(data) != fields[0].length:
            raise Nack(GvcpStatus.BAD_ADDRESS, f"{len(data)} bytes into {fields[0].name}")
        values = {feature: _decode(feature, data) for feature in fields}
        changed = {feature: value for feature, value in values.items() if value != self._value(feature)}
        for feature, value in changed.items():
            self._check(feature, value)
        for feature, value in changed.items():
            if feature.kind != "command":
                self.put(feature.name, value)
        return tuple(feature.name for feature in changed)

    def _write_text(self, feature: Feature, data: bytes) -> tuple[str, ...]:
        if len(data) > feature.length:
            raise Nack(GvcpStatus.BAD_PARAMETER, f"{len(data)} bytes into {feature.name}")
        self._store(feature.address, data.ljust(feature.length, b"\0"))
        return (feature.name,)

    def _value(self, feature: Feature) -> float:
        return self.real(feature.name) if feature.kind == "float" else self.integer(feature.name)

    def _check(self, feature: Feature, value: float) -> None:
        if feature.locked and self.integer("TLParamsLocked"):
            raise Nack(GvcpStatus.ACCESS_DENIED, f"{feature.name} is locked while streaming")
        if feature.entries:
            allowed = any(value == number for _, number in feature.entries)
        else:
            allowed = feature.minimum <= value <= self._maximum(feature)  # false for NaN
            if feature.kind == "integer":
                allowed = allowed and (value - feature.minimum) % feature.increment == 0
        if not allowed:
            raise Nack(GvcpStatus.BAD_PARAMETER, f"{feature.name} cannot be {value}")

    def _maximum(self, feature: Feature) -> float:
        if feature.headroom is None:
            return feature.maximum
        whole, used = feature.headroom
        return self.integer(whole) - self.integer(used)

    def _find(self, address: int, count: int) -> tuple[bytearray, int]:
        for begin, segment in self._segments.items():
            if begin <= address and address + count <= begin + len(segment):
                return segment, address - begin
        raise Nack(GvcpStatus.BAD_ADDRESS, f"{count} bytes at {address:#x}")

    def _load(self, address: int, count: int) -> bytes:
        segment, offset = self._find(address, count)
        return bytes(segment[offset : offset + count])

    def _store(self, address: int, data: bytes) -> None:
        segment, offset = self._find(address, len(data))
        segment[offset : offset + len(data)] = data


def get_largest(feature: Feature) -> int:
    """All bits of the feature's field."""
    return (1 << (feature.bits or 8 * feature.length)) - 1


def _extract_field(feature: Feature, word: int) -> int:
    return word >> feature.lsb & get_largest(feature)


def _decode(feature: Feature, data: bytes) -> float:
    if feature.kind == "float":
        (value,) = struct.unpack(">d", data)
        return value
    return _extract_field(feature, int.from_bytes(data, "big"))


# The device's end of GVCP: who is in control, what each command does; datagrams in, datagrams out, no socket.
#
# Reads are open to all. Writes belong to the one peer that took the control channel privilege (CCP), and it keeps the
# privilege only while it is heard: the heartbeat is real time, as the peer's is.


Peer = tuple[str, int]

CCP = 0x0A00
_EXCLUSIVE, _CONTROL = 1, 2


class GvcpDevice(Protocol):
    """What the commands act on."""

    def before_read(self, address: int, count: int) -> None:
        """Bring the registers of this range up to date; Nack when they cannot be read."""
        ...

    def after_write(self, name: str) -> None:
        """The feature was changed, or the command given."""
        ...

    def resend(self, resend: Resend) -> None:
        """Queue packets once more."""
        ...

    def control_ended(self) -> None:
        """Note that no client is in control any more."""
        ...


_STRANGER: Peer = ("192.0.2.1", 3956)


class ControlChannel:
    """The control protocol of one device; times are s of the host's boot time."""

    def __init__(self, registers: Registers, device: GvcpDevice) -> None:
        self._registers = registers
        self._device = device
        self._controller: Peer | None = None
        self._heard_s = 0.0
        self._answered: tuple[Peer, bytes] | None = None
        self._answer = b""

    def feed(self, datagram: bytes, peer: Peer, now_s: float) -> bytes:
        """The reply to one datagram, b"" for none. A repeated command is answered again but not executed again."""
        try:
            request = gvcp.decode_request(datagram)
        except gvcp.Malformed:
            return b""
        if peer == self._controller:
            self._heard_s = now_s
        if self._answered == (peer, datagram):
            return self._answer
        ack = self._execute(request, peer, now_s)
        if ack is None or not request.flags & gvcp.ACK_WANTED:
            return b""
        self._answered, self._answer = (peer, datagram), ack.encode()
        return self._answer

    def check_heartbeat(self, now_s: float) -> None:
        """Take the privilege from a controller that has been silent for too long."""
        timeout_s = self._registers.integer("GevHeartbeatTimeout") / 1000
        if self._controller not in (None, _STRANGER) and now_s - self._heard_s > timeout_s:
            self._release()

    def seize(self, on: bool) -> None:
        """Let another client take control and keep its heartbeat up, or let go."""
        if self._controller is not None and (on or self._controller == _STRANGER):
            self._release()
        if on:
            self._controller = _STRANGER
            self._registers.put("GevCCP", _CONTROL)

    def forget(self) -> None:
        """The device lost its power: no controller, nothing remembered, no client informed."""
        self._controller = None
        self._answered = None

    def _execute(self, request: GvcpRequest, peer: Peer, now_s: float) -> Ack | None:
        """The acknowledge; None for a command that has none."""
        try:
            match request.command:
                case GvcpCommand.DISCOVERY:
                    payload = self._registers.read(0, DISCOVERY_bytes)
                case GvcpCommand.READREG:
                    addresses = gvcp.unpack_words(request.payload)
                    payload = b"".join(self._read(address, 4) for address in addresses)
                case GvcpCommand.READMEM:
                    address, count = gvcp.unpack_read_memory(request.payload)
                    payload = gvcp.pack_write_memory(address, self._read(address, count))
                case GvcpCommand.WRITEREG:
                    payload = self._write_registers(gvcp.unpack_words(request.payload), peer, now_s)
                case GvcpCommand.WRITEMEM:
                    address, data = gvcp.unpack_write_memory(request.payload)
                    self._write(address, data, peer, now_s)
                    payload = gvcp.pack_written(len(data))
                case GvcpCommand.PACKETRESEND:
                    self._device.resend(gvcp.unpack_resend(request))
                    return None
                case _:
                    raise Nack(GvcpStatus.NOT_IMPLEMENTED, f"command {request.command:#06x}")
        except Nack as refused:
            if request.command == GvcpCommand.PACKETRESEND:
                return None
            return Ack(request.command, request.req_id, status=refused.status)
        return Ack(request.command, request.req_id, payload)

    def _read(self, address: int, count: int) -> bytes:
        if address % 4:
            raise Nack(GvcpStatus.BAD_ALIGNMENT, f"register {address:#x}")
        self._device.before_read(address, count)
        return self._registers.read(address, count)

    def _write_registers(self, words: tuple[int, ...], peer: Peer, now_s: float) -> bytes:
        if len(words) % 2:
            raise Nack(GvcpStatus.BAD_PARAMETER, "an address without a value")
        for address, value in zip(words[::2], words[1::2], strict=True):
            self._write(address, value.to_bytes(4, "big"), peer, now_s)
        return gvcp.pack_written(len(words) // 2)

    def _write(self, address: int, data: bytes, peer: Peer, now_s: float) -> None:
        if address == CCP and len(data) == 4:
            self._claim(int.from_bytes(data, "big"), peer, now_s)
            return
        if peer != self._controller:
            raise Nack(GvcpStatus.ACCESS_DENIED, f"{peer} is not in control")
        for name in self._registers.write(address, data):
            self._device.after_write(name)

    def _claim(self, value: int, peer: Peer, now_s: float) -> None:
        """A write to CCP: take, keep or release the privilege."""
        if self._controller not in (None, peer):
            raise Nack(GvcpStatus.ACCESS_DENIED, f"{self._controller} is in control")
        privilege = value & (_EXCLUSIVE | _CONTROL)
        if privilege:
            self._controller, self._heard_s = peer, now_s
            self._registers.put("GevCCP", privilege)
        elif self._controller is not None:
            self._release()

    def _release(self) -> None:
        self._controller = None
        self._registers.put("GevCCP", 0)
        self._registers.put("GevSCPHostPort", 0)
        self._device.control_ended()
