"""A byte link, serial or TCP: blocking, with real-time time-outs; used from one thread at a time."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import termios
import time
from dataclasses import dataclass
from typing import Protocol

import serial

from thermostand.foundation.addresses import SerialEndpoint, TcpEndpoint, get_display_address, parse_address
from thermostand.foundation.clock import Now, await_simulated_answers
from thermostand.foundation.errors import Unreachable

_CONNECT_S = 1.0  # round number; nothing was measured
_WRITE_S = 1.0  # a device that takes no bytes must not hold the caller
_READ_SIZE = 4096  # one read of the kernel; longer replies take several
CLOSING_S = 0.02  # from a reply to the end of its connection: a round trip of a slow network
DELIVERY_S = 0.02  # from one end of a pseudo-terminal to the other; 0.1 ms on an idle host


class ByteLink(Protocol):
    """What a byte protocol needs of its wire. write and read raise Unreachable when the wire is gone."""

    def write(self, data: bytes) -> None:
        """Send all of `data`."""
        ...

    def read(self, timeout_s: float) -> bytes:
        """Return what has arrived, waiting at most `timeout_s` (0: not at all) for the first byte; b"" when nothing
        came."""
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


def read_reply(link: ByteLink, deadline_s: float, clock: Now | None) -> bytes:
    """Return what has arrived until time.monotonic() reaches `deadline_s`; b"" then. In virtual time a host that is
    busy must not make a silent device: silent is one that has nothing left to answer."""
    left_s = deadline_s - time.monotonic()
    if left_s > 0 and (data := link.read(left_s)):
        return data
    return link.read(DELIVERY_S) if await_simulated_answers(clock) else b""


def open_link(device: str, address: str, settings: SerialSettings) -> ByteLink:
    """Open `serial:PATH` (exclusively) or `tcp:HOST:PORT` for `device`; raises Unreachable, or ValueError when
    `address` is neither."""
    place = parse_address(address)
    if isinstance(place, SerialEndpoint):
        return _SerialLink(device, place.path, get_display_address(address).removeprefix("serial:"), settings)
    return _TcpLink(device, place, get_display_address(address).removeprefix("tcp:"))


class _SerialLink:
    """A port opened by pyserial. Its bytes go by the descriptor: pyserial waits twice for each reply, and after each
    request for space for the next one."""

    def __init__(self, device: str, path: str, where: str, settings: SerialSettings) -> None:
        self._device = device
        self._where = where
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
            raise Unreachable(device, f"cannot open {where}: {explain_closed(error)}") from error

    def write(self, data: bytes) -> None:
        try:
            if rest := data[_write_at_once(self._port.fileno(), data) :]:
                self._port.write(rest)  # waits for space
        except (OSError, termios.error) as error:
            raise Unreachable(self._device, f"{self._where} is gone ({error})") from error

    def read(self, timeout_s: float) -> bytes:
        try:
            port = self._port.fileno()
            if not select.select([port], [], [], timeout_s)[0]:
                return b""
            data = os.read(port, _READ_SIZE)
        except BlockingIOError:
            return b""
        except (OSError, termios.error) as error:
            raise Unreachable(self._device, f"{self._where} is gone ({error})") from error
        if not data:  # ready, and yet nothing: unplugged
            raise Unreachable(self._device, f"{self._where} is gone (nothing to read where there should be)")
        return data

    def close(self) -> None:
        with contextlib.suppress(OSError, termios.error):
            self._port.close()


def _write_at_once(port: int, data: bytes) -> int:
    """Return how many bytes the port has space for."""
    try:
        return os.write(port, data)
    except BlockingIOError:
        return 0


class HangUps:
    """Whether a peer closes each connection after one reply, as some gateways do: that says nothing of who answers
    next, while a connection that breaks otherwise does. is_known: it did so twice in a row."""

    def __init__(self) -> None:
        self.is_known = False
        self._replies = self._in_a_row = 0
        self._is_cleared = False

    @property
    def is_suspect(self) -> bool:
        """One reply came over this connection, and no earlier one has carried more."""
        return self._replies == 1 and not self._is_cleared

    def opened(self) -> None:
        """A new connection."""
        self._replies = 0

    def answered(self) -> None:
        """One more reply over it."""
        self._replies += 1
        if self._replies > 1:
            self._in_a_row, self._is_cleared = 0, True

    def note_close(self) -> bool:
        """The peer has closed it; whether it did after one reply, so that a read may be asked over another one."""
        if self._replies != 1:
            return False
        self._in_a_row += 1
        self.is_known = self.is_known or self._in_a_row > 1
        return True


def explain_closed(error: Exception) -> str:
    """Return why a port cannot be opened, in one clause: the words of pyserial have its name twice."""
    number = error.errno if isinstance(error, OSError) else None
    if number in (errno.EAGAIN, errno.EBUSY):
        return "another program has it open"
    return os.strerror(number) if number else str(error)


class _TcpLink:
    def __init__(self, device: str, place: TcpEndpoint, where: str) -> None:
        self._device = device
        self._where = where
        try:
            self._socket = socket.create_connection(place, timeout=_CONNECT_S)
        except OSError as error:
            raise Unreachable(device, f"cannot connect to {where}: {error.strerror or error}") from error
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
