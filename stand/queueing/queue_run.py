"""How one run of a queue is performed: begun, or resumed in the session it has."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection
from pathlib import Path

from thermostand.foundation.errors import ConfigError, Interrupted, SessionError, StandError, StandTripped
from thermostand.foundation.events import NOT_CONFIRMED_SAFE
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event, Item, StepMark, StepState
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.estimating.learned import learn
from thermostand.stand.estimating.run_estimate import price_night
from thermostand.stand.queueing.queue import order_of
from thermostand.stand.queueing.queue_file import Entry
from thermostand.stand.queueing.queue_work import Halt, Notes
from thermostand.stand.running.memory.entries import Ended
from thermostand.stand.running.memory.journal import Journal
from thermostand.stand.running.resume import Interruption, interruption, is_of_virtual_time
from thermostand.stand.running.run import resume, run_real, run_virtual
from thermostand.stand.running.session_report import NotReported, check_reportable, report_session
from thermostand.stand.watching.live import followed


async def run_entry(directory: Path, entry: Entry, notes: Notes, *, virtual_time: bool) -> Path:
    """Run `entry` into a session below `directory`, or resume the one it has; it is shown while it runs.

    Returns the session's folder. Halt when an interrupted run cannot be resumed, or one that failed has left the stand
    not confirmed safe; else raises as a run does.
    """
    session = directory / entry.session if entry.session else None
    if session is not None and await asyncio.to_thread(is_complete, session):
        return session  # killed between its end and the note of it
    order = order_of(entry)
    before = None if session is None else await asyncio.to_thread(interruption_of, session, order.config)
    night = price_night(tuple(order.recipe.plan()) if before is None else before.state.plan, order.config, directory)
    watch = Watch(frozenset() if before is None else before.kept.done, notes.step_done)
    try:
        is_virtual = virtual_time or is_of_virtual_time(before)
        with followed(order, night, directory, is_virtual=is_virtual, before=before) as show:

            def subscribe(hub: Hub) -> None:
                show(hub)
                hub.subscribe(watch)

            if before is not None:
                return await resume(before, subscribe)
            if virtual_time:
                return await run_virtual(order, directory, None, subscribe, notes.begun)
            return await run_real(order, directory, subscribe, notes.begun)
    except (Interrupted, StandTripped):
        raise
    except StandError as error:
        if watch.unsafe:
            raise Halt(f"{error}; NOT SAFE: {'; '.join(watch.unsafe)}") from error
        raise


class Watch:
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


def conclude(entry: Entry, session: Path, tell: Callable[[str], None], *, report: bool) -> None:
    """What follows a complete run, which none of it makes fail: what it teaches about durations is kept for the next,
    and with `report` the drift is fitted and reported in the session's folder, when the recipe has any. Takes a minute.
    """
    order = order_of(entry)
    try:
        learn(session.parent, order.config)
    except (SessionError, OSError) as error:
        tell(f"warning: {error}")
    if not report:
        return
    try:
        check_reportable(order.recipe.plan())
        for line in report_session(session, session).lines:
            tell(line)
    except (ConfigError, NotReported) as error:
        tell(f"{session.name}: {error}")
    except Exception as error:  # noqa: BLE001 - a fit that fails must not end the queue
        tell(f"{session.name}: is recorded, but not reported: {type(error).__name__}: {error}")


def interruption_of(session: Path, own: StandConfig, *, clear: bool = False) -> Interruption:
    """What is left of the run of a session, for this stand; Halt when it cannot be resumed."""
    try:
        return interruption(session, own, clear=clear)
    except (SessionError, ConfigError) as error:
        raise Halt(str(error)) from error


def is_complete(session: Path) -> bool:
    """Whether the run recorded in `session` came to its end; Halt when its journal does not say."""
    try:
        journal, entries = Journal.open(session)
    except SessionError as error:
        raise Halt(str(error)) from error
    journal.release()
    last = entries[-1] if entries else None
    return isinstance(last, Ended) and last.status == "complete"
