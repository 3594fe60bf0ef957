"""One run on one stand: a lock per resolved address, taken before any device is opened, held until it ends or dies.

Where the machine has a folder for its stands' locks (`presence.lock_folder`), each lock of a real stand is a locked
file there, which says who has it: only the stand's group can take one. Elsewhere each lock is two: such a file in the
user's runtime folder, and a name in the kernel's abstract socket namespace, which holds among all users of this
machine and when a logout has removed the runtime folder, but which any user could take first. Another host on the same
gateway is not kept away.
"""

from __future__ import annotations

import asyncio
import errno
import hashlib
import ipaddress
import json
import os
import re
import socket
import threading
from collections.abc import AsyncGenerator, Generator, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, asynccontextmanager, closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple, cast

from thermostand.foundation.addresses import SerialEndpoint, parse_address
from thermostand.foundation.errors import InUse, SessionError
from thermostand.foundation.lock_file import release_lock, take_lock, try_lock
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.safety.latch import LatchFile
from thermostand.stand.serving.instances import (
    STANDS_FOLDER,
    find_lock_folder,
    find_runtime_folder,
    list_runtime_folders,
)

_HEATING = ("bus", "regulator")  # of the addresses: two stands that share a camera are two stands


class LockAddress(NamedTuple):
    """The address of a device: `place` is the same for every way to write the address, and for nothing else on this
    machine."""

    device: str
    place: str


def list_addresses(config: StandConfig) -> tuple[LockAddress, ...]:
    """List where a run of this stand reads and switches: the bus, and each device by its kind.

    Real flaps, cameras and stages count by their serial numbers, too: behind another address they are the same ones. Of
    a simulated laboratory there may be several, with the same numbers. Asks the name service, and so may take a while.
    """
    found = [LockAddress("bus", place) for place in _list_places(config.bus.address)]
    for name, kind, settings in config.equipment:
        for how, text in kind.places(settings) if settings is not None else ():
            if how == "wire":
                found += [LockAddress(name, place) for place in _list_places(text)]
            elif how == "host":
                found.append(LockAddress(name, _format_place(kind.name, text)))
            elif how == "name" or config.simulation is None:
                found.append(LockAddress(name, text))
    return tuple(found)


def find_latch_file(config: StandConfig) -> LatchFile:
    """Return what is latched of the stand of a configuration; asks the name service, as `addresses`."""
    places = sorted({each.place for each in list_addresses(config) if each.device in _HEATING})
    return LatchFile.for_addresses(make_file_name(place.partition(" in net:")[0]) for place in places)


def _list_places(address: str) -> Iterator[str]:
    """The name that was given for a serial port counts as well: after a replug it leads to another device file."""
    place = parse_address(address)
    if isinstance(place, SerialEndpoint):
        yield from {f"serial {os.path.abspath(place.path)}", f"serial {os.path.realpath(place.path)}"}
        return
    for ip in _resolve(place.host):
        yield _format_place("tcp", ip, f":{place.port}")


def _resolve(host: str) -> set[str]:
    """The IP addresses of a host; its name when they are unknown."""
    try:
        return {str(found[4][0]) for found in socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)}
    except (OSError, UnicodeError):
        return {host.lower()}


def _format_place(kind: str, host: str, port: str = "") -> str:
    """0.0.0.0 leads to this machine; its own addresses mean another machine in each network namespace."""
    try:
        ip = ipaddress.ip_address(host)
    except ValueError:
        return f"{kind} {host}{port}"
    if ip.is_unspecified:
        ip = ipaddress.ip_address("127.0.0.1" if ip.version == 4 else "::1")
    namespace = f" in {os.readlink('/proc/self/ns/net')}" if ip.is_loopback else ""
    return f"{kind} {ip}{port}{namespace}"


_HOLDER_TRIES, _HOLDER_PAUSE_S = 10, 0.02


@asynccontextmanager
async def lock_stand(config: StandConfig, session: Path | None, command: str = "") -> AsyncGenerator[None]:
    """Every address of the stand belongs to the run of `session` while inside, without one to a daemon, or to a
    `command` that is over soon.

    InUse when another run has one of them: then nothing was touched. SessionError when the runtime folder cannot be
    used.
    """
    wanted = await asyncio.to_thread(list_addresses, config)
    with _lock_all(wanted, session, config, command):
        yield


def _lock_all(
    wanted: Iterable[LockAddress], session: Path | None, config: StandConfig, command: str
) -> AbstractContextManager[object]:
    """All of them, or none and what `claimed` raises. In one order for all processes: of two that want the same ones,
    one gets them."""
    content: dict[str, object] = {"session": os.path.abspath(session) if session else "", "pid": os.getpid()}
    content |= {"stand": config.name, "command": command}
    # Simulated laboratories are nobody's hardware: any user may have one of his own.
    shared = None if config.simulation is not None else find_lock_folder()
    lock = partial(_lock_among_users, find_runtime_folder()) if shared is None else partial(_lock_file, shared, 0o660)
    stack = ExitStack()
    try:
        for place, device in sorted({address.place: address.device for address in wanted}.items()):
            stack.enter_context(lock(device, {**content, "place": place}))
    except BaseException:
        stack.close()
        raise
    return stack


@contextmanager
def _lock_among_users(folder: Path, device: str, content: Mapping[str, object]) -> Generator[None]:
    """The file in this user's folder, and the name that every user sees."""
    place = str(content["place"])
    with closing(socket.socket(socket.AF_UNIX)) as name:
        try:
            name.bind(f"\0thermostand {hashlib.sha256(place.encode()).hexdigest()}")
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise _make_in_use(device, place) from error
            raise SessionError(f"{place}: cannot be locked ({error.strerror})") from error
        with _lock_file(folder, 0o600, device, content):
            yield


@contextmanager
def _lock_file(folder: Path, mode: int, device: str, content: Mapping[str, object]) -> Generator[None]:
    place = str(content["place"])
    path = folder / make_file_name(place)
    try:
        file = take_lock(path, json.dumps(content).encode(), mode)
    except OSError as error:
        raise SessionError(f"{path}: cannot be locked ({error.strerror})") from error
    if file is None:
        raise _make_in_use(device, place)
    try:
        yield
    finally:
        release_lock(path, file)


def _make_in_use(device: str, place: str) -> InUse:
    named = place.partition(" in net:")[0]  # people do not know a network namespace by its number
    return InUse(device, f"{named} is in use by {_describe_holder(make_file_name(place))}; nothing was touched")


def make_file_name(place: str, suffix: str = ".lock") -> str:
    """Make a file name that people can read, and that is one of its own for each place."""
    digest = hashlib.sha256(place.encode()).hexdigest()[:8]
    return f"{re.sub(r'[^A-Za-z0-9._]+', '-', place)[:80]}-{digest}{suffix}"


def _describe_holder(file_name: str) -> str:
    """Describe who has the lock, as words of the sentence; a process that is just taking it writes its name a moment
    later."""
    for _ in range(_HOLDER_TRIES):
        for folder in (*list_runtime_folders(), STANDS_FOLDER):
            with suppress(OSError, ValueError, LookupError, TypeError):
                return _describe_lock(folder / file_name)
        threading.Event().wait(_HOLDER_PAUSE_S)
    return "a run of another user or login"


def find_daemon_pid(config: StandConfig) -> int | None:
    """The process of the daemon that has any address of this stand; None when none has. May take a while, as
    `addresses`."""
    for address in list_addresses(config):
        for folder in (*list_runtime_folders(), STANDS_FOLDER):
            with suppress(OSError, ValueError, LookupError, TypeError):
                text = _read_lock(folder / make_file_name(address.place))
                if not text["session"] and not text.get("command"):
                    return int(str(text["pid"]))
    return None


def _read_lock(path: Path) -> dict[str, object]:
    """Return what the locked file says; LookupError when no process has it locked, else what reading raises."""
    with path.open("rb") as file:
        if try_lock(file.fileno(), shared=True):
            raise LookupError(path)
        return cast("dict[str, object]", json.loads(file.read()))


def _describe_lock(path: Path) -> str:
    """Describe in words who has it; raises as `_said`."""
    text = _read_lock(path)
    daemon = f"`{text['command']}`" if text.get("command") else "the daemon of `stand serve`"
    who = f"session {text['session']}" if text["session"] else daemon
    return f"{who} (pid {text['pid']})"
