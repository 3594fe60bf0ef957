"""Works a queue of runs: one at a time, until it is empty or must not go on without an operator."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

from drivers.clock import Now
from drivers.interface import DeviceError, SessionError, StandError, StandTripped
from stand.queue import finish, note_session, queued, take
from stand.queue_file import Entry, State, working
from stand.stop import Interrupted

# Runs the entry, or goes on with it when it has a session, and returns the session's folder; the second argument is
# told the folder as soon as a run that is killed could be resumed in it.
RunOne = Callable[[Entry, Callable[[Path], None]], Awaitable[Path]]


async def work(directory: Path, run_one: RunOne, clock: Now, tell: Callable[[str], None]) -> None:
    """Run what is queued in `directory` until nothing is left; `tell` gets a line for every beginning and end.

    A run that fails is marked and the next one begun, unless the stand tripped, `run_one` raises Halt, a device did not
    answer before the run had begun (the next would fail likewise), or the failure is a mistake of the program: then the
    queue is halted and the error raised. What an operator stops is interrupted, ends the work, and is resumed by the
    next one.
    """
    with working(directory):
        while (entry := take(directory, clock.now_ns())) is not None:
            tell(f"run {entry.id} ({entry.recipe}) " + (f"goes on in {entry.session}" if entry.session else "begins"))
            await _Run(directory, entry, clock, tell).perform(run_one)


class Halt(StandError):
    """The queue must not go on before an operator has looked; the text says why."""


class _Run:
    def __init__(self, directory: Path, entry: Entry, clock: Now, tell: Callable[[str], None]) -> None:
        self._directory = directory
        self._entry = entry
        self._clock = clock
        self._tell = tell

    async def perform(self, run_one: RunOne) -> None:
        try:
            session = await run_one(self._entry, self._note_session)
        except (Interrupted, asyncio.CancelledError) as error:
            self._end(State.INTERRUPTED, str(error) or "stopped by the operator")
            raise
        except (StandTripped, Halt) as error:
            self._end(State.FAILED, str(error), halt=True)
            raise
        except StandError as error:
            halt = isinstance(error, DeviceError) and not self._has_session()
            self._end(State.FAILED, str(error), halt=halt)
            if halt:
                raise
        except Exception as error:
            self._end(State.FAILED, f"{type(error).__name__}: {error}", halt=True)
            raise
        else:
            self._note_session(session)
            self._end(State.DONE)

    def _has_session(self) -> bool:
        return any(entry.id == self._entry.id and entry.session for entry in queued(self._directory).entries)

    def _note_session(self, session: Path) -> None:
        try:
            note_session(self._directory, self._entry.id, session)
        except SessionError as error:  # no reason to end a run that goes well
            self._tell(f"run {self._entry.id} ({self._entry.recipe}) cannot be noted: {error}")

    def _end(self, state: State, reason: str = "", *, halt: bool = False) -> None:
        finish(self._directory, self._entry.id, state, self._clock.now_ns(), reason, halt=halt)
        self._tell(f"run {self._entry.id} ({self._entry.recipe}) {state}" + (f": {reason}" if reason else ""))
