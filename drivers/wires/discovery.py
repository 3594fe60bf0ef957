"""What is connected to this computer: serial ports, USB devices, and GigE cameras at addresses that are asked.

Cameras are asked by GVCP's DISCOVERY command (GigE Vision 2.2, 16.1.1), at each given address alone. A broadcast
reaches every camera of a network, and other laboratories' too: only an address that is given as one is a broadcast.
"""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from ipaddress import IPv4Address
from pathlib import Path

from serial.tools import list_ports

GVCP_PORT = 3956
_REQUEST = struct.pack(">BBHHH", 0x42, 0x11, 0x0002, 0, 0xFFFF)
"""Acknowledge wanted, a broadcast one allowed, no payload."""
_ACK_CODE = 0x0003
_HEAD = struct.Struct(">HHHH")
_LEAST_BYTES = 0xE8
_TEXTS = {"make": (0x48, 32), "model": (0x68, 32), "firmware": (0x88, 32), "serial": (0xD8, 16)}
_ADDRESS_AT = 0x24

_STAGES = "Standa stage controller 8SMC4/8SMC5 (axes)"
_FLAP = "Pololu Jrk G2 motor controller (flap)"
_KNOWN_USB = {(0x1CBE, 0x0007): _STAGES} | {(0x1FFB, product): _FLAP for product in (0xB7, 0xB9, 0xBF, 0xC1, 0xC5)}


@dataclass(frozen=True, slots=True)
class SerialPort:
    """address: what `address:` of a stand's file takes, a name that stays with the device where there is one."""

    address: str
    what: str
    serial: str


@dataclass(frozen=True, slots=True)
class UsbDevice:
    """vendor, product: their numbers, as in `idVendor` of a udev rule."""

    vendor: int
    product: int
    what: str
    serial: str


@dataclass(frozen=True, slots=True)
class FoundCamera:
    """A camera that has answered at `address`."""

    address: str
    make: str
    model: str
    firmware: str
    serial: str


def list_serial_ports() -> tuple[SerialPort, ...]:
    """List the serial ports with hardware behind them, by address."""
    lasting = {path.resolve(): str(path) for path in _links("/dev/serial/by-id", "/dev/ximc")}
    found: list[SerialPort] = []
    for port in list_ports.comports():
        if port.hwid == "n/a":
            continue  # a name in /dev without hardware behind it
        names = (port.manufacturer or "", port.product or port.description or "")
        words = " ".join(dict.fromkeys(word for word in names if word and word != "n/a"))
        what = _KNOWN_USB.get((port.vid or 0, port.pid or 0), words)
        found.append(SerialPort(lasting.get(Path(port.device).resolve(), port.device), what, port.serial_number or ""))
    return tuple(sorted(found, key=lambda port: port.address))


def list_usb_devices(root: Path = Path("/sys/bus/usb/devices")) -> tuple[UsbDevice, ...]:
    """All but hubs, as the kernel lists them: nothing is opened, and no right to do so is needed."""
    found: list[UsbDevice] = []
    for device in sorted(root.glob("*")):
        vendor, product = _text(device / "idVendor"), _text(device / "idProduct")
        if not vendor or not product or _text(device / "bDeviceClass") == "09":
            continue
        numbers = int(vendor, 16), int(product, 16)
        words = f"{_text(device / 'manufacturer')} {_text(device / 'product')}".strip()
        found.append(UsbDevice(*numbers, _KNOWN_USB.get(numbers) or words, _text(device / "serial")))
    return tuple(found)


def _links(*folders: str) -> list[Path]:
    with suppress(OSError):
        return [path for folder in folders if Path(folder).is_dir() for path in sorted(Path(folder).iterdir())]
    return []


def _text(path: Path) -> str:
    with suppress(OSError):
        return path.read_text(encoding="utf-8", errors="replace").strip()
    return ""


async def find_cameras(addresses: Sequence[str], limit_s: float) -> tuple[FoundCamera, ...]:
    """The GigE Vision cameras that answer within `limit_s` (real seconds), by address; each address is asked twice, for
    a datagram may be lost. ValueError for one that is no IPv4 address, OSError for one that cannot be reached."""
    for address in addresses:
        IPv4Address(address)
    loop = asyncio.get_running_loop()
    hearing = _Hearing()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.setblocking(False)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        opened.bind(("0.0.0.0", 0))  # the answer comes to the interface that the question went out of
        transport, _ = await loop.create_datagram_endpoint(lambda: hearing, sock=opened)
        try:
            for _ in range(2):
                for address in addresses:
                    transport.sendto(_REQUEST, (address, GVCP_PORT))
                await asyncio.sleep(limit_s / 2)
        finally:
            transport.close()
    if hearing.failure is not None and not hearing.found:
        raise hearing.failure
    return tuple(hearing.found[address] for address in sorted(hearing.found))


class _Hearing(asyncio.DatagramProtocol):
    def __init__(self) -> None:
        self.found: dict[str, FoundCamera] = {}
        self.failure: Exception | None = None

    def error_received(self, exc: Exception) -> None:
        """A network that this computer has no way to; a refused port is only a computer that is no camera."""
        if not isinstance(exc, ConnectionRefusedError):
            self.failure = exc

    def datagram_received(self, data: bytes, addr: tuple[str | object, ...]) -> None:
        """What is no answer of a camera is left alone."""
        camera = decode_answer(data)
        if camera is not None:
            self.found[camera.address] = camera


def decode_answer(datagram: bytes) -> FoundCamera | None:
    """A DISCOVERY acknowledge: the first 0xF8 bytes of the camera's registers behind its head; None for anything
    else."""
    if len(datagram) < _HEAD.size + _LEAST_BYTES:
        return None
    status, code, length, request = _HEAD.unpack_from(datagram)
    registers = datagram[_HEAD.size :]
    if status != 0 or code != _ACK_CODE or request != 0xFFFF or length > len(registers):
        return None
    texts = {
        name: registers[at : at + size].split(b"\0", 1)[0].decode("utf-8", "replace").strip()
        for name, (at, size) in _TEXTS.items()
    }
    return FoundCamera(socket.inet_ntoa(registers[_ADDRESS_AT : _ADDRESS_AT + 4]), **texts)
