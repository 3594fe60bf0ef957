"""The control socket of a running daemon: one JSON object a line in, one out. It lies in the runtime folder (see
`presence`), not in the session's, and is served (see `door`) without ever asking the session's disk.

    {"do": "status"}    -> {"ok": true, "status": {...}}           the fields of RunStatus
    {"do": "pause"}     -> {"ok": true, "reasons": ["operator"],   held before the next action; a dwell keeps its time
                            "moving": ["linear to 250 mm"]}        what still moves: that is not stopped
    {"do": "continue"}  -> {"ok": true, "reasons": [...]}          ends a pause; what still holds the run, if anything
    {"do": "clear"}     -> {"ok": true, "reasons": [...]}          an operator has removed what tripped an interlock
    {"do": "stop"}      -> {"ok": true}                            the stand is made safe, then the run ends

Anything wrong is answered with {"ok": false, "error": sentence}. A connection may carry many requests; one that is
longer than 64 KiB, has no line end or does not come for 60 s is the last one, and of too many connections the one that
was silent longest is ended. Only the user who started the daemon may connect (mode 0600). Every time-out here is in
real seconds.
"""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import AsyncGenerator, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from dataclasses import replace
from pathlib import Path

from foundation.errors import SessionError
from stand.gate import INTERLOCK, OPERATOR, Gate
from stand.serving.desk import RunStatus
from stand.serving.door import Answer, Door, Handlers
from stand.serving.presence import Entry, Presence


def handlers(
    gate: Gate, stop: Callable[[], object], status: Callable[[], RunStatus], moving: Callable[[], list[str]] = list
) -> Handlers:
    """The requests of the module's table; `stop` latches and cancels, and returns at once. moving: what is under way,
    as in `linear to 250 mm`."""

    def held() -> Answer:
        return {"reasons": sorted(gate.reasons)}

    def pause(_: Mapping[str, object]) -> Answer:
        gate.hold(OPERATOR)
        return {**held(), "moving": moving()}

    def continue_(_: Mapping[str, object]) -> Answer:
        gate.clear(OPERATOR)
        return held()

    def clear(_: Mapping[str, object]) -> Answer:
        if INTERLOCK not in gate.reasons:
            raise SessionError("there is nothing to clear: no interlock holds this run")
        gate.clear(INTERLOCK)
        return held()

    def end(_: Mapping[str, object]) -> Answer:
        stop()
        return {}

    def tell(_: Mapping[str, object]) -> Answer:
        return {"status": status().model_dump(mode="json")}

    return {"status": tell, "pause": pause, "continue": continue_, "clear": clear, "stop": end}


@asynccontextmanager
async def serve(session: Path, stand: str, handlers: Handlers) -> AsyncGenerator[None]:
    """Answer for the daemon that runs `session` on the stand of this name while inside; what a handler returns is sent
    with "ok": true, the text of an error it raises as the error.

    SessionError when the runtime folder cannot be used. A socket or entry that somebody removes is made again within
    some seconds.
    """
    entry = Entry(os.path.abspath(session), os.getpid(), stand)  # noqa: ASYNC240 - no disk is asked
    presence = Presence(entry)
    listening = presence.appear()

    def look_after() -> None:
        if not presence.is_there():
            with suppress(SessionError):  # tried again the next time
                door.listen(presence.appear())

    door = Door(handlers, look_after)
    try:
        door.listen(listening)
        _identified(entry, presence.tell)
        yield
    finally:
        await door.close()
        presence.disappear()


def _identified(entry: Entry, tell: Callable[[Entry], None]) -> None:
    """Note what the disk says of the session's folder, when it does: nothing waits for a disk that hangs."""
    loop = asyncio.get_running_loop()

    def look() -> None:
        with suppress(OSError, RuntimeError):  # no such folder; the loop has ended meanwhile
            found, real_path = os.stat(entry.session), os.path.realpath(entry.session)
            identity = (found.st_dev, found.st_ino)
            loop.call_soon_threadsafe(tell, replace(entry, real_path=real_path, identity=identity))

    threading.Thread(target=look, name="session-folder", daemon=True).start()
