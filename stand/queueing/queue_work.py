"""Runs a queue of runs: one at a time, until it is empty or needs an operator."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from foundation.clock import Now
from foundation.errors import DeviceError, InUse, SessionError, StandError, StandTripped
from stand.queueing.queue import finish, note_session, note_step, queued, take
from stand.queueing.queue_file import Entry, State, working
from stand.running.stop import Interrupted

MOST_FRUITLESS_STARTS = 3


@dataclass(frozen=True, slots=True)
class Notes:
    """What a run reports while it is under way.

    begun: its session's folder, as soon as a run that is killed could be resumed in it. step_done: it has finished a
    step that it had not finished before.
    """

    begun: Callable[[Path], None]
    step_done: Callable[[], None]


# Runs the entry, or resumes it when it has a session, and returns the session's folder.
RunOne = Callable[[Entry, Notes], Awaitable[Path]]


async def work(directory: Path, run_one: RunOne, clock: Now, tell: Callable[[str], None]) -> None:
    """Run what is queued in `directory` until nothing is left; `tell` gets a line for every beginning and end.

    A run that fails is marked and the next one begun, unless the stand tripped, `run_one` raises Halt, a device did not
    answer before the run had begun (the next would fail likewise), or the failure is a mistake of the program: then the
    queue is halted and the error raised. What an operator stops, or finds the stand in use by another run, is
    interrupted, ends the work, and is resumed by the next one. A run whose daemon was killed MOST_FRUITLESS_STARTS
    times in a row before one more step was done is marked as failed, or it would keep all others from their turn.
    """
    with working(directory):
        while (entry := take(directory, clock.now_ns())) is not None:
            run = _Run(directory, entry, clock, tell)
            if entry.fruitless_starts >= MOST_FRUITLESS_STARTS:
                run.set_aside()
            else:
                await run.perform(run_one)


class Halt(StandError):
    """The queue must not continue before an operator has looked; the text says why."""


class _Run:
    def __init__(self, directory: Path, entry: Entry, clock: Now, tell: Callable[[str], None]) -> None:
        self._directory = directory
        self._entry = entry
        self._clock = clock
        self._tell = tell
        self._name = f"run {entry.id} ({entry.recipe})"
        self._has_stepped = False

    def set_aside(self) -> None:
        """Fail without another try."""
        left = f"; `stand resume {self._directory / self._entry.session}` tries again" if self._entry.session else ""
        times = f"{self._entry.fruitless_starts} times in a row"
        self._end(State.FAILED, f"its daemon was killed {times} before one more step was done{left}")

    async def perform(self, run_one: RunOne) -> None:
        """Run or resume it; raises what ends the work."""
        entry = self._entry
        self._tell(f"{self._name} " + (f"is resumed in {entry.session}" if entry.session else "begins"))
        try:
            session = await run_one(entry, Notes(self._note_session, self._note_step))
        except (Interrupted, InUse, asyncio.CancelledError) as error:
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
        with self._noting():
            note_session(self._directory, self._entry.id, session)

    def _note_step(self) -> None:
        if self._has_stepped:
            return
        self._has_stepped = True
        with self._noting():
            note_step(self._directory, self._entry.id)

    @contextmanager
    def _noting(self) -> Generator[None]:
        """A queue that cannot be written is no reason to end a run that goes well."""
        try:
            yield
        except SessionError as error:
            self._tell(f"{self._name} cannot be noted: {error}")

    def _end(self, state: State, reason: str = "", *, halt: bool = False) -> None:
        finish(self._directory, self._entry.id, state, self._clock.now_ns(), reason, halt=halt)
        self._tell(f"{self._name} {state}" + (f": {reason}" if reason else ""))
