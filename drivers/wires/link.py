"""A byte link, serial or TCP: blocking, with real-time time-outs; used from one thread at a time."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import termios
from dataclasses import dataclass
from typing import Protocol

import serial

from foundation.addresses import SerialPlace, place_of
from foundation.errors import Unreachable

_CONNECT_S = 1.0
_WRITE_S = 1.0  # a device that takes no bytes must not hold the caller
_READ_SIZE = 4096


class ByteLink(Protocol):
    """What a byte protocol needs of its wire. write and read raise Unreachable when the wire is gone."""

    def write(self, data: bytes) -> None:
        """Send all of `data`."""
        ...

    def read(self, timeout_s: float) -> bytes:
        """What has arrived, waiting at most `timeout_s` (0: not at all) for the first byte; b"" when nothing came."""
        ...

    def close(self) -> None:
        """Let go; may be called twice."""
        ...


@dataclass(frozen=True, slots=True)
class SerialSettings:
    """Baud, stop bits, parity, data bits."""

    baud: int
    stopbits: int
    parity: str = "N"
    databits: int = 8


def open_link(device: str, address: str, settings: SerialSettings) -> ByteLink:
    """Open `serial:PATH` (exclusively) or `tcp:HOST:PORT` for `device`; raises Unreachable, or ValueError when
    `address` is neither."""
    place = place_of(address)
    if isinstance(place, SerialPlace):
        return _SerialLink(device, place.path, settings)
    return _TcpLink(device, place.host, place.port)


class _SerialLink:
    def __init__(self, device: str, path: str, settings: SerialSettings) -> None:
        self._device = device
        self._path = path
        try:
            self._port = serial.Serial(
                path,
                settings.baud,
                bytesize=settings.databits,
                parity=settings.parity,
                stopbits=settings.stopbits,
                timeout=0,
                write_timeout=_WRITE_S,
                exclusive=True,
            )
        except (OSError, termios.error) as error:
            raise Unreachable(device, f"cannot open {path}: {why_closed(error)}") from error

    def write(self, data: bytes) -> None:
        try:
            self._port.write(data)
        except (OSError, termios.error) as error:
            raise Unreachable(self._device, f"{self._path} is gone ({error})") from error

    def read(self, timeout_s: float) -> bytes:
        try:
            if timeout_s > 0:  # waited for here, because pyserial reconfigures the whole port for another time-out
                select.select([self._port], [], [], timeout_s)
            return self._port.read(_READ_SIZE)
        except (OSError, termios.error) as error:
            raise Unreachable(self._device, f"{self._path} is gone ({error})") from error

    def close(self) -> None:
        with contextlib.suppress(OSError, termios.error):
            self._port.close()


def why_closed(error: Exception) -> str:
    """Why a port cannot be opened, in one clause: the words of pyserial have its name twice."""
    number = error.errno if isinstance(error, OSError) else None
    if number in (errno.EAGAIN, errno.EBUSY):
        return "another program has it open"
    return os.strerror(number) if number else str(error)


class _TcpLink:
    def __init__(self, device: str, host: str, port: int) -> None:
        self._device = device
        self._where = f"{host}:{port}"
        try:
            self._socket = socket.create_connection((host, port), timeout=_CONNECT_S)
        except OSError as error:
            raise Unreachable(device, f"cannot connect to {self._where}: {error.strerror or error}") from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def write(self, data: bytes) -> None:
        try:
            self._socket.settimeout(_WRITE_S)
            self._socket.sendall(data)
        except OSError as error:
            raise Unreachable(self._device, f"{self._where} is gone ({error})") from error

    def read(self, timeout_s: float) -> bytes:
        try:
            self._socket.settimeout(timeout_s)
            data = self._socket.recv(_READ_SIZE)
        except (TimeoutError, BlockingIOError):
            return b""
        except OSError as error:
            raise Unreachable(self._device, f"{self._where} is gone ({error})") from error
        if not data:
            raise Unreachable(self._device, f"{self._where} closed the connection")
        return data

    def close(self) -> None:
        self._socket.close()
