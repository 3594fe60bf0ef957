"""The addresses at which a stand's devices answer, resolved, so that two spellings of one address are one."""

from __future__ import annotations

import ipaddress
import os
import socket
from collections.abc import Iterator
from typing import NamedTuple

from foundation.addresses import SerialPlace, place_of
from stand.config.stand_config import StandConfig


class Address(NamedTuple):
    """Of a device: `place` is the same for every way to write the address, and for nothing else on this machine."""

    device: str
    place: str


def addresses(config: StandConfig) -> tuple[Address, ...]:
    """Where a run of this stand reads and switches: the bus, each axis, the flap and the camera.

    Real flaps, cameras and stages count by their serial numbers, too: behind another address they are the same ones. Of
    a simulated laboratory there may be several, with the same numbers. Asks the name service, and so may take a while.
    """
    flap, camera, is_real = config.flap, config.camera, config.simulation is None
    found = [Address("bus", place) for place in _places(config.bus.address)]
    for name, axis in config.axes.items():
        found += [Address(name, place) for place in _places(axis.address)]
        if is_real:
            found.append(Address(name, f"stage {axis.serial_number}"))
    if flap.backend_address is not None:
        found += [Address("flap", place) for place in _places(flap.backend_address)]
    else:
        found.append(Address("flap", f"usb {flap.serial_number}"))
    found.append(Address("camera", _of_host("camera", camera.address)))
    if is_real and camera.serial_number is not None:
        found.append(Address("camera", f"camera {camera.serial_number}"))
    return tuple(found)


def _places(address: str) -> Iterator[str]:
    """The name that was given for a serial port counts as well: after a replug it leads to another device file."""
    place = place_of(address)
    if isinstance(place, SerialPlace):
        yield from {f"serial {os.path.abspath(place.path)}", f"serial {os.path.realpath(place.path)}"}
        return
    for ip in _resolved(place.host):
        yield _of_host("tcp", ip, f":{place.port}")


def _resolved(host: str) -> set[str]:
    """The IP addresses of a host; its name when nobody knows it."""
    try:
        return {str(found[4][0]) for found in socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)}
    except (OSError, UnicodeError):
        return {host.lower()}


def _of_host(kind: str, host: str, port: str = "") -> str:
    """0.0.0.0 leads to this machine; its own addresses mean another machine in each network namespace."""
    try:
        ip = ipaddress.ip_address(host)
    except ValueError:
        return f"{kind} {host}{port}"
    if ip.is_unspecified:
        ip = ipaddress.ip_address("127.0.0.1" if ip.version == 4 else "::1")
    namespace = f" in {os.readlink('/proc/self/ns/net')}" if ip.is_loopback else ""
    return f"{kind} {ip}{port}{namespace}"
