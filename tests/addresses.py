"""Addresses for fakes and servers of a test that no other worker, and no other test run of this machine, is given."""

import itertools
import os
import socket
from functools import cache
from pathlib import Path
from typing import Any

# Below the kernel's ephemeral ports, which it hands out to every client on this machine.
_FIRST_PORT, _PORTS_PER_WORKER = 10_000, 1_500

WORKER = "TEST_WORKER"
"""In the environment of a worker this is its number."""
_ports, _cameras = itertools.count(os.getpid()), itertools.count()


def find_free_port() -> int:
    """A TCP port of 127.0.0.1 that nobody listens at, and that this worker has not been given for a long time."""
    first = _FIRST_PORT + int(os.environ.get(WORKER, "0")) % 14 * _PORTS_PER_WORKER
    for number in itertools.islice(_ports, _PORTS_PER_WORKER):
        port = first + number % _PORTS_PER_WORKER
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as servers do
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise OSError(f"no port from {first} on is free")


def allocate_camera_address() -> str:
    """An address of 127.0.0.0/8 that this process has not given to a camera for a long time: the port of GVCP is fixed,
    and a laboratory whose daemon was killed keeps its own for a minute."""
    return f"127.{1 + os.getpid() // 250 % 60}.{1 + os.getpid() % 250}.{1 + next(_cameras) % 254}"


@cache
def get_usual_camera_address() -> str:
    """The address of the cameras that this process makes one after the other. For tests, not for their modules: these
    are imported once for all workers."""
    return allocate_camera_address()


def move_to_free(stand: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The data of a simulated stand, moved to addresses of its own; its pseudo-terminals lie in the folder."""
    stand["bus"]["address"] = f"tcp:127.0.0.1:{find_free_port()}"
    for name, axis in stand["axes"].items():
        axis["address"] = f"serial:{folder / name}"
    if "flap" in stand:
        stand["flap"]["backend_address"] = f"tcp:127.0.0.1:{find_free_port()}"
    for device in (stand.get("climate_chamber"), *stand.get("probes", {}).values()):
        if device is not None:
            device["address"] = f"tcp:127.0.0.1:{find_free_port()}"
    for camera in stand["cameras"].values():
        camera["address"] = allocate_camera_address()
    stand["simulation"]["control"] = f"tcp:127.0.0.1:{find_free_port()}"
    return stand
