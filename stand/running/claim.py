"""One run on one stand: a lock per resolved address, taken before any device is opened, let go at the end or by death.

Each lock is two: a locked file in the runtime folder, which says who has it, and a name in the kernel's abstract socket
namespace. The name holds among all users of this machine, and when a logout has removed the runtime folder. Another
host on the same gateway is not kept away.
"""

from __future__ import annotations

import asyncio
import errno
import hashlib
import json
import os
import re
import socket
import threading
from collections.abc import AsyncGenerator, Generator, Iterable, Mapping
from contextlib import AbstractContextManager, ExitStack, asynccontextmanager, closing, contextmanager, suppress
from pathlib import Path
from typing import cast

from foundation.errors import InUse, SessionError
from foundation.lock_file import remove, take, try_lock
from stand.config.stand_config import StandConfig
from stand.running.addresses import Address, addresses
from stand.runtime import runtime_folder, runtime_folders

_HOLDER_TRIES, _HOLDER_PAUSE_S = 10, 0.02


@asynccontextmanager
async def claimed(config: StandConfig, session: Path) -> AsyncGenerator[None]:
    """Every address of the stand belongs to the run of `session` while inside.

    InUse when another run has one of them: then nothing was touched. SessionError when the runtime folder cannot be
    used.
    """
    wanted = await asyncio.to_thread(addresses, config)
    with _claimed(wanted, session, config.name):
        yield


def _claimed(wanted: Iterable[Address], session: Path, stand: str) -> AbstractContextManager[object]:
    """All of them, or none and what `claimed` raises. In one order for everybody: of two that want the same ones,
    one gets them."""
    folder = runtime_folder()
    content = {"session": os.path.abspath(session), "pid": os.getpid(), "stand": stand}
    stack = ExitStack()
    try:
        for place, device in sorted({address.place: address.device for address in wanted}.items()):
            stack.enter_context(_lock(folder / _file_name(place), device, {**content, "place": place}))
    except BaseException:
        stack.close()
        raise
    return stack


@contextmanager
def _lock(path: Path, device: str, content: Mapping[str, object]) -> Generator[None]:
    place = str(content["place"])
    with closing(socket.socket(socket.AF_UNIX)) as name:
        try:
            name.bind(f"\0thermostand {hashlib.sha256(place.encode()).hexdigest()}")
            file = take(path, json.dumps(content).encode())
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise SessionError(f"{path}: cannot be locked ({error.strerror})") from error
            file = None
        if file is None:
            named = place.partition(" in net:")[0]  # people do not know a network namespace by its number
            raise InUse(device, f"{named} is in use by {_holder(path.name)}; nothing was touched")
        try:
            yield
        finally:
            remove(path, file)


def _file_name(place: str) -> str:
    """To be read by people, and one of its own for each place."""
    digest = hashlib.sha256(place.encode()).hexdigest()[:8]
    return f"{re.sub(r'[^A-Za-z0-9._]+', '-', place)[:80]}-{digest}.lock"


def _holder(file_name: str) -> str:
    """Who says to have the lock, in the words of the sentence; whoever takes it just now says so in a moment."""
    for _ in range(_HOLDER_TRIES):
        for folder in runtime_folders():
            with suppress(OSError, ValueError, LookupError, TypeError):
                return _told(folder / file_name)
        threading.Event().wait(_HOLDER_PAUSE_S)
    return "a run of another user or login"


def _told(path: Path) -> str:
    """What the locked file says; LookupError when nobody has it locked, else what reading raises."""
    with path.open("rb") as file:
        if try_lock(file.fileno(), shared=True):
            raise LookupError(path)
        said = cast("dict[str, object]", json.loads(file.read()))
    return f"session {said['session']} (pid {said['pid']})"
