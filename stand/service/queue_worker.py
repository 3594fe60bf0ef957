"""Runs a queue of runs: one at a time, until it is empty or needs an operator."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Collection
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from thermostand.foundation.clock import Now
from thermostand.foundation.errors import (
    ConfigError,
    DeviceError,
    Interrupted,
    InUse,
    SessionError,
    StandError,
    StandTripped,
)
from thermostand.foundation.events import NOT_CONFIRMED_SAFE
from thermostand.foundation.items import Event, Item, StepMark, StepState
from thermostand.foundation.shutdown_deadline import ShutdownDeadline
from thermostand.recording.writing.disk import DiskCalls
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.running.memory.entries import Ended
from thermostand.stand.running.memory.journal import Journal
from thermostand.stand.running.resume import Interruption, load_interruption
from thermostand.stand.service.queue import finish, load_queue, note_session, note_step, take
from thermostand.stand.service.queue_file import QueueEntry, QueueState

MOST_FRUITLESS_STARTS = 3  # round number; nothing was measured
_NOTED_WITHIN_S = 1.0  # real seconds that a disk may take for the note of a run's end; it is written later, then


@dataclass(frozen=True, slots=True)
class RunNotes:
    """What a run reports while it is under way.

    begun: its session's folder, as soon as a run that is killed could be resumed in it; noted when it returns.
    step_done: it has finished a step that it had not finished before.
    """

    begun: Callable[[Path], Awaitable[None]]
    step_done: Callable[[], None]


# Runs the entry, or resumes it when it has a session, and returns the session's folder.
RunOne = Callable[[QueueEntry, RunNotes], Awaitable[Path]]


async def drain(
    directory: Path,
    run_one: RunOne,
    clock: Now,
    tell: Callable[[str], None],
    disk: DiskCalls,
    deadline: ShutdownDeadline,
) -> None:
    """Run what is queued in `directory`, on which the caller is `working`, until nothing is left; `tell` gets a line
    for every beginning and end. shutdown_deadline: with the disk at a run's end.

    A run that fails is marked and the next one begun, unless the stand tripped, `run_one` raises Halt, a device did not
    answer before the run had begun (the next would fail likewise), or the failure is a mistake of the program: then the
    queue is halted and the error raised. A run that raises Interrupted, or finds the stand in use by another run, ends
    the work, and is resumed by the next one; one that raises Stopped has ended. A run whose daemon was killed
    MOST_FRUITLESS_STARTS times in a row before one more step was done is marked as failed, or it would keep all others
    from their turn.
    """
    while (entry := await disk.call(take, directory, clock.now_ns())) is not None:
        run = _QueuedRun(directory, entry, clock, tell, disk, deadline)
        if entry.fruitless_starts >= MOST_FRUITLESS_STARTS:
            await run.give_up()
        else:
            await run.perform(run_one)


class Stopped(StandError):
    """An operator has stopped the run, which has ended by that. halts: whether the queue waits for an operator, too."""

    def __init__(self, text: str, *, halts: bool) -> None:
        super().__init__(text)
        self.halts = halts


class Halt(StandError):
    """The queue must not continue before an operator has looked; the text says why."""


class _QueuedRun:
    def __init__(
        self,
        directory: Path,
        entry: QueueEntry,
        clock: Now,
        tell: Callable[[str], None],
        disk: DiskCalls,
        deadline: ShutdownDeadline,
    ) -> None:
        self._directory = directory
        self._entry = entry
        self._clock = clock
        self._tell = tell
        self._name = f"run {entry.id} ({entry.recipe})"
        self._has_stepped = False
        self._disk = disk
        self._deadline = deadline
        self._notes: list[asyncio.Task[None]] = []

    async def give_up(self) -> None:
        """Fail without another try."""
        left = f"; `stand resume {self._directory / self._entry.session}` tries again" if self._entry.session else ""
        times = f"{self._entry.fruitless_starts} times in a row"
        await self._end(QueueState.FAILED, f"its daemon was killed {times} before one more step was done{left}")

    async def perform(self, run_one: RunOne) -> None:
        """Run or resume it; raises what ends the work."""
        entry = self._entry
        self._tell(f"{self._name} " + (f"is resumed in {entry.session}" if entry.session else "begins"))
        try:
            session = await run_one(entry, RunNotes(self._note_session, self._note_step))
        except (Interrupted, InUse, asyncio.CancelledError) as error:
            await self._end(QueueState.INTERRUPTED, str(error) or "stopped by the operator")
            raise
        except Stopped as error:
            await self._end(QueueState.STOPPED, str(error), halt=error.halts)
            if error.halts:
                raise
        except (StandTripped, Halt) as error:
            await self._end(QueueState.FAILED, str(error), halt=True)
            raise
        except StandError as error:
            halt = isinstance(error, DeviceError) and not await self._has_session()
            await self._end(QueueState.FAILED, str(error), halt=halt)
            if halt:
                raise
        except Exception as error:
            await self._end(QueueState.FAILED, f"{type(error).__name__}: {error}", halt=True)
            raise
        else:
            await self._note_session(session)
            await self._end(QueueState.DONE)

    async def _has_session(self) -> bool:
        await self._wait_for_notes()
        found = await self._disk.call(load_queue, self._directory)
        return any(entry.id == self._entry.id and entry.session for entry in found.entries)

    async def _note_session(self, session: Path) -> None:
        await self._write(note_session, session)

    def _note_step(self) -> None:
        """Write the step to the queue's file while the run goes on."""
        if not self._has_stepped:
            self._has_stepped = True
            self._notes.append(asyncio.create_task(self._write(note_step)))

    async def _write(self, function: Callable[..., None], *arguments: object) -> None:
        """A queue that cannot be written is no reason to end a run that goes well."""
        try:
            await self._disk.call(function, self._directory, self._entry.id, *arguments)
        except SessionError as error:
            self._tell(f"{self._name} cannot be noted: {error}")

    async def _wait_for_notes(self) -> None:
        await asyncio.gather(*self._notes)

    async def _end(self, state: QueueState, reason: str = "", *, halt: bool = False) -> None:
        """Noted when the disk takes that in time: one that hangs keeps nobody from leaving."""
        sentence = f"{self._name} {state}" + (f": {reason}" if reason else "")
        now_ns = self._clock.now_ns()
        change = partial(finish, self._directory, self._entry.id, state, now_ns, reason, halt=halt)
        noting = asyncio.create_task(self._note_last(change))
        try:
            if await self._deadline.wait(noting, _NOTED_WITHIN_S):
                await noting
        finally:
            if not noting.done():
                noting.cancel()
                sentence += "; the disk has not answered, so the queue does not know it yet"
            self._tell(sentence)

    async def _note_last(self, change: Callable[[], None]) -> None:
        await self._wait_for_notes()
        await self._disk.call(change)


class StepWatch:
    """Reports steps that were not done before, and keeps which actuators have not confirmed their safe state."""

    def __init__(self, done: Collection[str], step_done: Callable[[], None]) -> None:
        self.unsafe: list[str] = []
        self._done = done
        self._step_done = step_done

    def __call__(self, item: Item) -> None:
        """Follow one item."""
        if isinstance(item, Event) and item.kind == NOT_CONFIRMED_SAFE:
            self.unsafe.append(item.text)
        if isinstance(item, StepMark) and item.state is StepState.DONE and item.step_id not in self._done:
            self._step_done()


def load_queued_interruption(session: Path, own: StandConfig, *, reset: bool = False) -> Interruption:
    """Return what is left of the run of a session, for this stand; Halt when it cannot be resumed."""
    try:
        return load_interruption(session, own, reset=reset)
    except (SessionError, ConfigError) as error:
        raise Halt(str(error)) from error


def is_complete(session: Path) -> bool:
    """Return whether the run recorded in `session` came to its end; Halt when its journal does not say."""
    try:
        journal, entries = Journal.open(session)
    except SessionError as error:
        raise Halt(str(error)) from error
    journal.release()
    last = entries[-1] if entries else None
    return isinstance(last, Ended) and last.status == "complete"
