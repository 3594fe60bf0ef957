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
from typing import Literal

from pydantic import BaseModel, ConfigDict

from foundation.errors import SessionError
from stand.gate import INTERLOCK, OPERATOR, Gate
from stand.serving.door import Answer, Door, Handlers
from stand.serving.presence import Entry, Presence


class RunStatus(BaseModel):
    """The status of a run. Instants are ns since the epoch on the stand's clock, which may be virtual;
    utc_offset_ns makes now and later UTC as the host has it, since_utc_offset_ns and warning_utc_offset_ns the others.

    step: number of the step under way, 1 is the first. since_ns: when the present state began. end_ns: when the run is
    expected to end, None when unknown. temperatures_degC: by channel, None for a BAD reading. warning: the text of the
    last warning or error, published at warning_ns. fault_rule, fault: the rule that has tripped and holds or ends the
    run, and what was found, "" when all is well.
    """

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    recipe: str
    step: int
    steps: int
    doing: str
    state: Literal["running", "held", "stopping"]
    reasons: tuple[str, ...]
    now_ns: int
    since_ns: int
    end_ns: int | None
    temperatures_degC: dict[str, float | None]
    frames_saved: int
    frames_lost: int
    disk_free_bytes: int
    warning: str = ""
    warning_level: Literal["", "warning", "error"] = ""
    warning_ns: int | None = None
    utc_offset_ns: int = 0
    since_utc_offset_ns: int = 0
    warning_utc_offset_ns: int = 0
    fault_rule: str = ""
    fault: str = ""


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
