"""The part of a run in which things move: polled, guarded, journaled, and made safe on every way out."""

from __future__ import annotations

import asyncio
import importlib.metadata
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from compensation.target import Target
from drivers.clock import NS_PER_S
from drivers.documents import parse_document
from drivers.interface import SessionError, StandTripped
from stand.assembly import Assembly
from stand.estimating.estimate import price
from stand.estimating.learned import load_learned
from stand.guarding.guard import Guard
from stand.guarding.interlocks import Fault
from stand.hub import Event, Item
from stand.poller import Poller
from stand.recording.instants import utc_text
from stand.recording.recorder import Recorder
from stand.recording.superseded import restarted
from stand.remote.control import SOCKET_NAME, handlers, serve
from stand.remote.status import StatusBoard
from stand.running.gate import DISK_LOW, INTERLOCK, NOT_RECORDED, Gate
from stand.running.journal import Again, Cleared, Ended, Entry, Gap, Journal
from stand.running.logbook import Logbook
from stand.running.resume import Interruption, begun
from stand.running.scheduler import Progress, Scheduler
from stand.running.session_setup import Order
from stand.running.settling_watch import SettlingWatch
from stand.running.stop import OPERATOR, Stop
from stand.running.tasks import cancelled, watched
from stand.stand import Stand

# The recorder's events that hold a run, and those that let it go on.
_HOLDING = {"frames_stopped": DISK_LOW, "telemetry_not_saved": NOT_RECORDED}
_RELEASING = {"frames_resumed": DISK_LOW, "telemetry_saved_again": NOT_RECORDED}


@dataclass(frozen=True, slots=True)
class Performance:
    """What is run, by what, and what it goes on from. `begun` is told the folder when its journal is on the disk,
    `background` are tasks without which nothing goes on."""

    order: Order
    seed: int | None
    before: Interruption | None
    begun: Callable[[Path], None]
    assembly: Assembly
    recorder: Recorder
    stop: Stop
    background: tuple[asyncio.Task[None], ...]


async def perform(work: Performance) -> None:
    """The whole plan, or what is not done of it; the actuators are safe before anything else is taken down."""
    assembly, stop = work.assembly, work.stop
    log = Logbook(assembly.hub, assembly.clock)
    assembly.stand.attended = work.order.attended
    pollers, guard = assembly.pollers(), _guard(assembly, stop, log)
    target = parse_document(work.order.target_text, Target, "target.yaml")
    settling = SettlingWatch(assembly.stand, assembly.hub, assembly.clock, target)
    watchers: list[asyncio.Task[None]] = []
    ended = Ended(0, "failed", "")
    try:
        scheduler = await watched(_begun(work, pollers, guard, log, settling), work.background)
        watchers.append(asyncio.create_task(_answer(work, log)))
        watchers.extend(asyncio.create_task(poller.run()) for poller in pollers)
        watchers.append(asyncio.create_task(guard.run()))
        stop.started()
        await watched(scheduler.run(work.order.recipe.plan()), [*work.background, *watchers])
        ended = Ended(0, "complete", "complete")
    except BaseException as error:
        ended = _ending(stop.fault, error)
        raise
    finally:
        stop.taking_down()
        assembly.stand.gate.let_go()  # what an operator presses now holds nothing
        try:
            log.tell("info" if ended.status == "complete" else "error", "run.end", ended.text)
        finally:  # also when somebody who listens fails
            await _taken_down(assembly.stand, watchers, pollers)
            settling.close()
            stop.ended()
            await log.end(ended)


async def _taken_down(stand: Stand, watchers: Sequence[asyncio.Task[None]], pollers: Iterable[Poller]) -> None:
    """The actuators safe, and nobody left who could move them; then one more look at every device, so that the
    recording ends with the safe state as the wire tells it."""
    try:
        await stand.make_safe()
    finally:
        await cancelled(watchers)
    for poller in pollers:
        await poller.poll()


async def _begun(
    work: Performance, pollers: Iterable[Poller], guard: Guard, log: Logbook, settling: SettlingWatch
) -> Scheduler:
    """Everything read and judged once, and the journal begun or continued: nothing moves before that."""
    for poller in pollers:
        await poller.first()
    if work.before is None:
        log.tell("info", "run.start", f"recipe {work.order.recipe.name}")
    else:
        _tell_interruption(work.before, work.assembly.clock.now_ns(), log)
        if work.before.again:
            event = restarted(work.assembly.clock.now_ns(), work.before.again[-1], work.before.superseded)
            work.assembly.hub.publish(event)
    if not await guard.check():
        raise StandTripped("the rules do not hold")
    await work.recorder.flushed()  # a session with a journal can be opened and resumed
    before = work.before
    journal = Journal.create(work.recorder.directory) if before is None else before.journal
    await log.begin(journal, *_first_entries(work))
    work.begun(work.recorder.directory)
    gate = work.assembly.stand.gate
    gate.subscribe(log.held)
    gate.subscribe(lambda reason, held: _forget_cleared(guard, reason, held))
    if guard.held is not None:  # by the first look, when there was no journal yet
        log.tripped(guard.held)
        log.held(INTERLOCK, True)
    work.assembly.hub.subscribe(_hold_while_not_recorded(gate))
    if before is not None and not before.set_up.camera_on:
        work.assembly.stand.camera_is_off(before.cooling)
    progress = None if before is None else before.progress
    assembly = work.assembly
    return Scheduler(assembly.stand, assembly.hub, assembly.clock, journal, work.recorder.flushed, settling, progress)


async def _answer(work: Performance, log: Logbook) -> None:
    """Answer at the control socket until cancelled; a run goes on without one."""
    assembly, before = work.assembly, work.before
    progress = Progress() if before is None else before.progress
    steps = price(work.order.recipe.plan(), work.order.config, load_learned(work.recorder.directory.parent))
    gate, stop, clock = assembly.stand.gate, work.stop, assembly.clock
    board = StatusBoard(work.order.recipe.name, steps, progress, gate, stop, work.recorder, clock)
    assembly.hub.subscribe(board)
    try:
        async with serve(work.recorder.directory / SOCKET_NAME, handlers(gate, stop, board.status)):
            await asyncio.Event().wait()
    except SessionError as error:
        log.tell("warning", "no_control", f"the run cannot be asked or paused: {error}")
        await asyncio.Event().wait()


def _first_entries(work: Performance) -> tuple[Entry, ...]:
    now_ns = work.assembly.clock.now_ns()
    if work.before is None:
        return (begun(work.order, work.recorder.directory.name, now_ns, work.seed),)
    cleared = (Cleared(now_ns),) if work.before.tripped else ()
    again = (Again(now_ns, list(work.before.again)),) if work.before.again else ()
    return (*cleared, Gap(work.before.last_ns, now_ns), *again)


def _tell_interruption(before: Interruption, now_ns: int, log: Logbook) -> None:
    """The end of the run that was interrupted, the gap since, and that it goes on."""
    if not before.ended:
        log.tell("error", "run.end", f"interrupted: killed after {utc_text(before.last_ns)}")
    gap_s = (now_ns - before.last_ns) / NS_PER_S
    span = f"from {utc_text(before.last_ns)} to {utc_text(now_ns)}"
    log.tell("warning", "gap", f"nothing was recorded and nobody watched the stand {span} ({gap_s:.3f} s)")
    if before.tripped:
        log.tell("warning", "cleared", f"an operator cleared: {before.tripped}")
    version = importlib.metadata.version("thermostand")
    done = f"{len(before.progress.done)} steps are done"
    log.tell("info", "run.resume", f"recipe {before.order.recipe.name} goes on, {done}; thermostand {version}")


def _guard(assembly: Assembly, stop: Stop, log: Logbook) -> Guard:
    """On a fault it ends the run, or makes the stand safe and lets the run wait for an operator."""

    def trip(fault: Fault) -> None:
        stop(fault)
        log.tripped(fault)

    def hold(fault: Fault) -> None:
        assembly.stand.gate.hold(INTERLOCK)
        log.tripped(fault)

    return assembly.guard(trip, hold)


def _forget_cleared(guard: Guard, reason: str, held: bool) -> None:
    """An operator has cleared the interlock: the guard's hold is over."""
    if reason == INTERLOCK and not held:
        guard.clear()


def _ending(fault: Fault | None, error: BaseException) -> Ended:
    """How a run ended that did not come to its end."""
    if fault is None:
        return Ended(0, "failed", f"failed: {error or 'cancelled'}")
    return Ended(0, "interrupted" if fault.rule == OPERATOR else "tripped", f"aborted: {fault.text}")


def _hold_while_not_recorded(gate: Gate) -> Callable[[Item], None]:
    """A subscriber: the run waits while the recorder cannot record frames, or telemetry."""

    def follow(item: Item) -> None:
        if isinstance(item, Event) and item.kind in _HOLDING:
            gate.hold(_HOLDING[item.kind])
        if isinstance(item, Event) and item.kind in _RELEASING:
            gate.clear(_RELEASING[item.kind])

    return follow
