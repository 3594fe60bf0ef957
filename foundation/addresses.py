"""Addresses as a configuration writes them: `serial:PATH`, `tcp:HOST:PORT`, IPv4. Checked and taken apart here only."""

from __future__ import annotations

import ipaddress
import re
from typing import Annotated, NamedTuple

from pydantic import AfterValidator

_TCP = re.compile(r"tcp:([^:\s]+):([0-9]{1,5})")
_SERIAL = re.compile(r"serial:([^\s\x00]+)")


class TcpEndpoint(NamedTuple):
    """A port of a host."""

    host: str
    port: int


class SerialEndpoint(NamedTuple):
    """The path of a serial port."""

    path: str


def parse_tcp_address(address: str, *, may_be_free: bool = False) -> TcpEndpoint:
    """Return where `tcp:HOST:PORT` leads; ValueError when it is none. Port 0, for a free one, only if it
    `may_be_free`."""
    found = _TCP.fullmatch(address)
    if found is None or not (0 if may_be_free else 1) <= int(found[2]) < 65536:
        raise ValueError("expected tcp:HOST:PORT with a port of 1..65535")
    return TcpEndpoint(found[1], int(found[2]))


def parse_address(address: str) -> SerialEndpoint | TcpEndpoint:
    """Return where `serial:PATH` or `tcp:HOST:PORT` leads; ValueError when it is neither."""
    if found := _SERIAL.fullmatch(address):
        return SerialEndpoint(found[1])
    if address.startswith("tcp:"):
        return parse_tcp_address(address)
    raise ValueError("expected serial:PATH (such as serial:/dev/ttyUSB0) or tcp:HOST:PORT")


def _check_byte_address(address: str) -> str:
    parse_address(address)
    return address


def _check_tcp_address(address: str) -> str:
    parse_tcp_address(address)
    return address


def _check_ip_address(address: str) -> str:
    try:
        return str(ipaddress.IPv4Address(address))
    except ValueError as error:
        raise ValueError("expected an IPv4 address such as 192.168.1.10") from error


_DISPLAY_ADDRESSES: dict[str, str] = {}  # where a stand's simulator answers -> what the stand's file says


def set_display_address(address: str, stated: str) -> None:
    """Let messages show `stated` for `address` from now on: a simulator answers at a free port, which differs each
    time, and the messages of a run are recorded."""
    _DISPLAY_ADDRESSES[address] = stated


def get_display_address(address: str) -> str:
    """Return how a message names `address`: as the stand's file does."""
    return _DISPLAY_ADDRESSES.get(address, address)


ByteAddress = Annotated[str, AfterValidator(_check_byte_address)]
TcpAddress = Annotated[str, AfterValidator(_check_tcp_address)]
IpAddress = Annotated[str, AfterValidator(_check_ip_address)]
