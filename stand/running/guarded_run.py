"""The part of a run in which things move: polled, guarded, journaled, and made safe on every way out."""

from __future__ import annotations

import asyncio
import importlib.metadata
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from foundation.clock import NS_PER_S, Clock, VirtualClock, boot_of, utc_offset_ns
from foundation.documents import parse_document
from foundation.errors import SessionError, StandTripped
from foundation.instants import utc_text
from foundation.items import Event, Item
from foundation.tasks import cancelled, cause_of, failure_text, watched
from markers.target import Target
from recording.reading.contents import RUN_END
from recording.reading.run_word import Run
from recording.writing.recorder import Recorder
from stand.assembly import Assembly
from stand.estimating.estimate import price
from stand.estimating.learned import load_learned
from stand.fault import Fault
from stand.gate import DISK_LOW, INTERLOCK, NOT_RECORDED, Gate
from stand.guarding.guard import Guard
from stand.poller import Poller
from stand.running.camera_gap import OffsetGap, OffsetWatch, doubt
from stand.running.entries import Cleared, Ended, Gap, Written
from stand.running.executor import Executor
from stand.running.fold import fold
from stand.running.holds import end_endless_holds, keep_shut_in_holds
from stand.running.journal import Journal, Logbook
from stand.running.order import Order, check_plan
from stand.running.resume import Interruption, begun, plan_hash
from stand.running.settling_watch import SettlingWatch, load_for
from stand.running.state import RunState
from stand.running.status import StatusBoard
from stand.running.stop import STOPPED_BY_OPERATOR, Stop
from stand.serving.control import handlers, serve

# The recorder's events that hold a run, and those that let it continue.
_HOLDING = {"frames_stopped": DISK_LOW, "telemetry_not_saved": NOT_RECORDED}
# A run in virtual time that is held for so many times the longest pause ends.
_VIRTUAL_PAUSES = 2
_RELEASING = {"frames_resumed": DISK_LOW, "telemetry_saved_again": NOT_RECORDED}


@dataclass(frozen=True, slots=True)
class GuardedRun:
    """What is run, by what, and what it is resumed from. `begun` gets the folder when its journal is on the disk,
    `background` are tasks whose end ends the run."""

    order: Order
    seed: int | None
    before: Interruption | None
    begun: Callable[[Path], None]
    assembly: Assembly
    recorder: Recorder
    stop: Stop
    background: tuple[asyncio.Task[None], ...]


async def run_guarded(work: GuardedRun) -> None:
    """The whole plan, or what is not done of it; the actuators are safe before anything else is taken down."""
    assembly, stop = work.assembly, work.stop
    plan, before = work.order.recipe.plan(), work.before
    load_for(work.order.recipe.plan())
    log = Logbook(assembly.hub, assembly.clock, fold(plan, ()) if before is None else before.state)
    assembly.stand.attended = work.order.attended
    pollers, guard = assembly.pollers(), _guard(work, log)
    target = parse_document(work.order.target_text, Target, "target.yaml")
    settling = SettlingWatch(assembly.stand, assembly.hub, assembly.clock, target)
    watchers: list[asyncio.Task[None]] = []
    ended = Ended(0, "failed", "")
    try:
        executor = await watched(_begun(work, pollers, guard, log, settling), work.background)
        watchers.append(asyncio.create_task(_answer(work, await _board(work, guard, log.state), log)))
        watchers.extend(asyncio.create_task(poller.run()) for poller in pollers)
        watchers.append(asyncio.create_task(guard.run()))
        watchers.append(asyncio.create_task(assembly.stand.chamber.keeper.run()))
        watchers.append(asyncio.create_task(keep_shut_in_holds(assembly.stand, assembly.hub, assembly.clock)))
        watchers.append(asyncio.create_task(assembly.stand.imaging.supply.opening.keep_open()))
        if isinstance(assembly.clock, VirtualClock):
            limit_h = _VIRTUAL_PAUSES * assembly.config.guard.pause_limit_h
            watchers.append(asyncio.create_task(end_endless_holds(assembly.stand.gate, assembly.clock, limit_h)))
        stop.started()
        await watched(executor.run(), [*work.background, *watchers])
        ended = Ended(0, "complete", "complete")
    except BaseException as error:
        ended = _ending(stop.fault, error)
        raise
    finally:
        stop.taking_down()
        assembly.stand.gate.let_go()  # what an operator presses now holds nothing
        try:
            level = "info" if ended.status == "complete" else "error"
            log.tell(level, RUN_END, ended.text, {"status": ended.status})
        finally:  # also when a subscriber fails
            await _taken_down(assembly, guard, watchers, pollers)
            settling.close()
            stop.ended()
            await log.end(ended)


async def _taken_down(
    assembly: Assembly, guard: Guard, watchers: Sequence[asyncio.Task[None]], pollers: Iterable[Poller]
) -> None:
    """The actuators safe, tried until they confirm it, and no task left that could move them; then one more look at
    every device, so that the recording ends with the safe state as read from the wire."""
    safety = assembly.stand.safety
    try:
        safety.demand()
        await safety.confirmed(assembly.config.guard.safe_limit_s)
    finally:
        await cancelled(watchers)
        await safety.close()
        await guard.told()
    for poller in pollers:
        await poller.poll()


async def _begun(
    work: GuardedRun, pollers: Iterable[Poller], guard: Guard, log: Logbook, settling: SettlingWatch
) -> Executor:
    """Everything read and judged once, and the journal begun or continued: nothing moves before that."""
    for poller in pollers:
        await poller.first()
    if work.before is None:
        log.tell("info", "run.start", f"recipe {work.order.recipe.name}", _begin_data(work, log.state))
    else:
        _tell_interruption(work, work.before, log)
    if not guard.look():
        raise StandTripped("a rule of the guard is violated")
    await work.recorder.flushed()  # a session with a journal can be opened and resumed
    before = work.before
    journal = Journal.create(work.recorder.directory) if before is None else before.journal
    await log.begin(journal, *_first_entries(work), disk=work.recorder.disk)
    work.recorder.beside(journal)
    work.begun(work.recorder.directory)
    gate = work.assembly.stand.gate
    gate.subscribe(log.held)
    gate.subscribe(lambda reason, held: _forget_cleared(guard, work, reason, held))
    if guard.held is not None:  # by the first look, when there was no journal yet
        log.tripped(guard.held)
        log.held(INTERLOCK, True)
    work.assembly.hub.subscribe(_hold_while_not_recorded(gate))
    if before is not None:
        _judge_camera(before, work.assembly)
    assembly, allowed = work.assembly, partial(check_plan, config=work.order.config)
    offsets = OffsetWatch(assembly.hub, assembly.clock, None if before is None else _gap(before, assembly.clock))
    flushed = work.recorder.flushed
    return Executor(assembly.stand, assembly.hub, assembly.clock, log, flushed, settling, offsets, allowed)


def _gap(before: Interruption, clock: Clock) -> OffsetGap:
    return OffsetGap(before.camera.offsets_K, before.last_ns, clock.now_ns())


def _judge_camera(before: Interruption, assembly: Assembly) -> None:
    """A camera that the plan has on, and that may have been off since, has lost its equilibrium."""
    stand, boot = assembly.stand, boot_of(assembly.clock)
    if not before.kept.set_up.camera_on:
        stand.imaging.supply.last = before.camera.last
    elif reason := doubt(
        before.camera,
        None if boot is None else boot.id,
        stand.imaging.supply.was_on,
        assembly.hub.latest("camera.temperature"),
    ):
        stand.imaging.supply.equilibrium.lose(reason)


def _begin_data(work: GuardedRun, state: RunState) -> dict[str, object]:
    """For a resume: whether the host has run on since, and which plan it is, should the journal have
    lost that. For counts of what is done: how many steps and frames the plan has."""
    plan, boot = plan_hash(work.order.recipe.plan()), boot_of(work.assembly.clock)
    data: dict[str, object] = {**state.size, "plan": plan, "seed": work.seed}
    return data if boot is None else {**data, "boot_id": boot.id}


async def _board(work: GuardedRun, guard: Guard, state: RunState) -> StatusBoard:
    """The published state of the run, from before its first step on."""
    assembly = work.assembly
    kept = state if work.before is None else work.before.kept
    with assembly.clock.hold():  # nothing moves yet: the disk may take its time
        learned = await asyncio.to_thread(load_learned, work.recorder.directory.parent)
    steps = price(state.plan, work.order.config, learned)
    gate, recorder, clock = assembly.stand.gate, work.recorder, assembly.clock
    name = work.order.recipe.name
    board = StatusBoard(name, steps, kept, gate, work.stop, lambda: guard.held, recorder, clock)
    assembly.hub.subscribe(board)
    return board


async def _answer(work: GuardedRun, board: StatusBoard, log: Logbook) -> None:
    """Answer at the control socket until cancelled; a run can do without one."""
    stand = work.assembly.stand
    table = handlers(stand.gate, work.stop, board.status, lambda: stand.motions.texts)
    try:
        async with serve(work.recorder.directory, work.order.config.name, table):
            await asyncio.Event().wait()
    except SessionError as error:
        log.tell("warning", "no_control", f"the run cannot be queried or paused: {error}")
        await asyncio.Event().wait()


def _first_entries(work: GuardedRun) -> tuple[Written, ...]:
    now_ns = work.assembly.clock.now_ns()
    if work.before is None:
        return (begun(work.order, work.recorder.directory.name, now_ns, work.seed),)
    cleared = (Cleared(now_ns),) if work.before.state.tripped else ()
    return (*cleared, Gap(work.before.last_ns, now_ns))


def _tell_interruption(work: GuardedRun, before: Interruption, log: Logbook) -> None:
    """The end of the run that was interrupted, the gap since, and that it is resumed."""
    clock = work.assembly.clock
    now_ns, last_utc_ns = clock.now_ns(), before.last_ns + before.utc_offset_ns
    if before.state.ended is None:
        log.tell("error", RUN_END, f"interrupted: killed after {utc_text(last_utc_ns)}", {"status": Run.INTERRUPTED})
    gap_s = (now_ns - before.last_ns) / NS_PER_S
    span = f"from {utc_text(last_utc_ns)} to {utc_text(now_ns + utc_offset_ns(clock))}"
    log.tell("warning", "gap", f"nothing was recorded and nobody watched the stand {span} ({gap_s:.3f} s)")
    if before.state.tripped:
        log.tell("warning", "cleared", f"an operator cleared: {before.state.tripped}")
    version = importlib.metadata.version("thermostand")
    done = f"{len(before.kept.done)} steps are done"
    log.tell(
        "info",
        "run.resume",
        f"recipe {before.order.recipe.name} is resumed, {done}; thermostand {version}",
        _begin_data(work, before.state),
    )


def _guard(work: GuardedRun, log: Logbook) -> Guard:
    """On a fault it ends the run, or makes the stand safe and lets the run wait for an operator, or for a disk."""
    gate = work.assembly.stand.gate

    def trip(fault: Fault) -> None:
        work.stop(fault)
        log.tripped(fault)

    def hold(fault: Fault) -> None:
        gate.hold(INTERLOCK)
        log.tripped(fault)

    def frames_are_due() -> bool:
        """From the camera, which is powered."""
        return work.assembly.stand.imaging.supply.is_on and log.state.frames_to_come

    return work.assembly.guard(trip, hold, lambda: gate.clear(INTERLOCK), work.recorder, frames_are_due)


def _forget_cleared(guard: Guard, work: GuardedRun, reason: str, held: bool) -> None:
    """An operator has cleared the interlock: the guard's hold is over. Of a folder that is lost another one is made."""
    if reason == INTERLOCK and not held:
        work.assembly.stand.chamber.permits.forgive()
        work.assembly.stand.safety.forgive()
        work.recorder.refound()
        guard.clear()


def _ending(fault: Fault | None, error: BaseException) -> Ended:
    """How a run ended that did not come to its end."""
    if fault is None:
        cause = cause_of(error)
        reason = "cancelled" if isinstance(cause, asyncio.CancelledError) else failure_text(cause)
        return Ended(0, "failed", f"failed: {reason}")
    return Ended(0, "stopped" if fault.rule == STOPPED_BY_OPERATOR else "tripped", f"aborted: {fault.text}")


def _hold_while_not_recorded(gate: Gate) -> Callable[[Item], None]:
    """A subscriber: the run waits while the recorder cannot record frames, or telemetry."""

    def follow(item: Item) -> None:
        if isinstance(item, Event) and item.kind in _HOLDING:
            gate.hold(_HOLDING[item.kind])
        if isinstance(item, Event) and item.kind in _RELEASING:
            gate.clear(_RELEASING[item.kind])

    return follow
