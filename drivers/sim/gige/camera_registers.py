"""The camera's memory: bootstrap block, feature registers and XML, with the rules of every write."""

from __future__ import annotations

import ipaddress
import struct
import zlib

from thermostand.drivers.sim.gige.genicam import XML_ADDRESS, XML_NAME, Feature, to_xml
from thermostand.drivers.sim.gige.gvcp import Nack, Status

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
        """Whether a bootstrap register lies there that says something; texts, such as the description's URL, are read
        whole and not by 4 or 8 bytes."""
        if count > _NUMBER_bytes:
            return address < BOOTSTRAP_bytes
        features = {at: fields[0].length for at, fields in self._at.items() if at < BOOTSTRAP_bytes}
        places = self._standing | features
        return any(address < begin + length and begin < address + count for begin, length in places.items())

    # ------------------------------------------------------------------------------------------ seen from the camera

    def integer(self, name: str) -> int:
        """The value of an integer, enumeration or boolean feature."""
        feature = self._table[name]
        return _field(feature, int.from_bytes(self._load(feature.address, feature.length), "big"))

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
        word = word & ~(largest(feature) << feature.lsb) | int(value) << feature.lsb
        self._store(feature.address, word.to_bytes(feature.length, "big"))

    def covers(self, name: str, address: int, count: int) -> bool:
        """Whether a read of `count` bytes at `address` touches the feature's register."""
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
            raise Nack(Status.WRITE_PROTECT, f"no register to write at {address:#x}")
        if any(feature.access == "RO" for feature in fields):
            raise Nack(Status.WRITE_PROTECT, f"{fields[0].name} is read only")
        if fields[0].kind == "string":
            return self._write_text(fields[0], data)
        if len(data) != fields[0].length:
            raise Nack(Status.BAD_ADDRESS, f"{len(data)} bytes into {fields[0].name}")
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
            raise Nack(Status.BAD_PARAMETER, f"{len(data)} bytes into {feature.name}")
        self._store(feature.address, data.ljust(feature.length, b"\0"))
        return (feature.name,)

    def _value(self, feature: Feature) -> float:
        return self.real(feature.name) if feature.kind == "float" else self.integer(feature.name)

    def _check(self, feature: Feature, value: float) -> None:
        if feature.locked and self.integer("TLParamsLocked"):
            raise Nack(Status.ACCESS_DENIED, f"{feature.name} is locked while streaming")
        if feature.entries:
            allowed = any(value == number for _, number in feature.entries)
        else:
            allowed = feature.minimum <= value <= self._maximum(feature)  # false for NaN
            if feature.kind == "integer":
                allowed = allowed and (value - feature.minimum) % feature.increment == 0
        if not allowed:
            raise Nack(Status.BAD_PARAMETER, f"{feature.name} cannot be {value}")

    def _maximum(self, feature: Feature) -> float:
        if feature.headroom is None:
            return feature.maximum
        whole, used = feature.headroom
        return self.integer(whole) - self.integer(used)

    def _find(self, address: int, count: int) -> tuple[bytearray, int]:
        for begin, segment in self._segments.items():
            if begin <= address and address + count <= begin + len(segment):
                return segment, address - begin
        raise Nack(Status.BAD_ADDRESS, f"{count} bytes at {address:#x}")

    def _load(self, address: int, count: int) -> bytes:
        segment, offset = self._find(address, count)
        return bytes(segment[offset : offset + count])

    def _store(self, address: int, data: bytes) -> None:
        segment, offset = self._find(address, len(data))
        segment[offset : offset + len(data)] = data


def largest(feature: Feature) -> int:
    """All bits of the feature's field."""
    return (1 << (feature.bits or 8 * feature.length)) - 1


def _field(feature: Feature, word: int) -> int:
    return word >> feature.lsb & largest(feature)


def _decode(feature: Feature, data: bytes) -> float:
    if feature.kind == "float":
        (value,) = struct.unpack(">d", data)
        return value
    return _field(feature, int.from_bytes(data, "big"))
