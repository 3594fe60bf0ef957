"""What a session says of a run that did not come to its end, and whether it may go on.

The journal tells which steps are done, the recording what they have left: a step whose end is recorded is done, and a
frame counts when its image and its description are both on the disk. Recipe, seed and target are those of the session,
whatever today's files are; the stand is this one (stand.running.own_stand).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from experiments.steps import Capture, PlannedStep
from foundation.errors import SessionError
from foundation.items import Event, StepState
from foundation.progress import late_progress
from recording.reading.contents import RUN_BEGINS, RUN_END
from recording.reading.glance import glance
from recording.reading.run_word import Run, last_run_event
from recording.reading.session import Session
from recording.reading.superseded import begins_of
from recording.repair.salvage import Salvaged, salvage_unfinished
from recording.writing.settings import SessionInfo
from stand.config.recipe import Recipe
from stand.config.stand_config import StandConfig
from stand.running.camera_gap import CameraBefore, camera_before
from stand.running.cold_start import cold_start
from stand.running.journal import Again, Begun, Cleared, Dwell, Ended, Entry, Journal, Step, Tripped
from stand.running.order_files import parse_order
from stand.running.own_stand import Difference, default_stand, on_this_stand
from stand.running.scheduler import Progress
from stand.running.session_setup import Order
from stand.running.set_up import SetUp


def begun(order: Order, run: str, time_ns: int, seed: int | None) -> Begun:
    """The first line of a run's journal."""
    return Begun(time_ns, run, plan_hash(order.recipe.plan()), _text_hashes(order.attachments()), seed)


def plan_hash(plan: Iterable[PlannedStep]) -> str:
    """The same for the same steps in the same order."""
    return hashlib.sha256("\n".join(planned.step_id for planned in plan).encode()).hexdigest()[:16]


def _text_hashes(texts: Mapping[str, str]) -> dict[str, str]:
    return {name: hashlib.sha256(text.encode()).hexdigest()[:16] for name, text in texts.items()}


@dataclass(frozen=True, slots=True)
class Interruption:
    """A run that may go on. Its journal is open, and so locked, until it is run or `release`d.

    last_ns: the last instant on the disk. seed: of the simulated laboratory. ended: how it ended, "" when it was
    killed. tripped: what an operator has cleared. salvaged: what had to be finished first. camera: what the session
    tells of it. again: ids of the steps of an interrupted warm-up that are done again, its capture last, which had
    `superseded` frames. utc_offset_ns: UTC minus the stand's clock at last_ns, as it is recorded. differences: between
    the configuration of the session and that of this stand, with which it goes on.
    """

    directory: Path
    order: Order
    info: SessionInfo
    journal: Journal
    progress: Progress
    set_up: SetUp
    last_ns: int
    seed: int | None
    ended: str
    tripped: str
    salvaged: tuple[Salvaged, ...]
    camera: CameraBefore
    again: tuple[str, ...] = ()
    superseded: int = 0
    utc_offset_ns: int = 0
    differences: tuple[Difference, ...] = ()

    def release(self) -> None:
        """Give the session free for another daemon; may be called twice."""
        self.journal.release()


def interruption(directory: Path, own: StandConfig | None = None, *, clear: bool = False) -> Interruption:
    """What is needed to go on with the run recorded in `directory` on this stand, the installed simulated one when no
    `own` is given; its unfinished segments are salvaged.

    ConfigError when only one of the two stands is simulated. SessionError when a daemon is running it, it is complete,
    it tripped and `clear` is not given, or journal, recording and this version of the program do not belong together.
    """
    journal, entries = Journal.open(directory)
    try:
        return _interruption(directory, journal, entries, own or default_stand(), clear)
    except BaseException:
        journal.release()
        raise


def _interruption(
    directory: Path, journal: Journal, entries: list[Entry], own: StandConfig, clear: bool
) -> Interruption:
    first = entries[0] if entries else None
    if not entries or not (isinstance(first, Begun) or journal.damage):
        raise SessionError(f"{directory}: its run had not begun when it was killed; begin a new run")
    last = entries[-1]
    if isinstance(last, Ended) and last.status == "complete":
        raise SessionError(f"{directory}: its run is complete; there is nothing to resume")
    tripped = _tripped(entries)
    if tripped and not clear:
        raise SessionError(f"{directory}: the stand tripped: {tripped}; look into it, then resume with --clear")
    with late_progress("salvage", 1.0) as report:
        salvaged = tuple(salvage_unfinished(directory.resolve().parent, report))
    session = Session.open(directory)
    if journal.damage:
        tripped = tripped or _recorded_trip(session, entries)
        _check_may_go_on(directory, session, entries, tripped, clear)
    begun = first if isinstance(first, Begun) else _recorded_begun(session)
    order = _order(session, begun)
    info = SessionInfo.of(session.metadata)
    config, differences = on_this_stand(order.config, own, directory, is_virtual=info.clock_source == "virtual")
    order = replace(order, config=config)
    found = _found(session, entries, order.recipe)
    last_ns = max(entries[-1].time_ns, glance(directory).end_ns or 0)
    progress = replace(found.progress, until_ns=last_ns)
    set_up = SetUp()
    for planned in order.recipe.plan():
        set_up = set_up.after(planned) if planned.step_id in progress.done else set_up
    return Interruption(
        directory,
        order,
        info,
        journal,
        progress,
        set_up,
        last_ns,
        begun.seed,
        last.text if isinstance(last, Ended) else "",
        tripped,
        salvaged,
        camera_before(session),
        found.again,
        found.superseded,
        session.utc.at(last_ns),
        differences,
    )


def _tripped(entries: Iterable[Entry]) -> str:
    """Why an operator has to look first; "" when nothing tripped, or it was cleared."""
    text = ""
    for entry in entries:
        if isinstance(entry, Tripped):
            text = text or entry.text
        if isinstance(entry, Cleared):
            text = ""
    return text


def _recorded_end(session: Session, entries: Sequence[Entry]) -> Event | None:
    """The end of the run by the recording, when its journal has lost that; None when it has an end or none is there."""
    event = last_run_event(session.events())
    if isinstance(entries[-1], Ended) or event is None or event.kind != RUN_END or event.time_ns < entries[-1].time_ns:
        return None
    return event


def _recorded_trip(session: Session, entries: Sequence[Entry]) -> str:
    """As `_tripped`, by the end that the recording tells of; of a damaged journal nobody knows what else is lost."""
    event = _recorded_end(session, entries)
    return event.text if event is not None and event.data.get("status") == Run.TRIPPED else ""


def _check_may_go_on(directory: Path, session: Session, entries: Sequence[Entry], tripped: str, clear: bool) -> None:
    """SessionError when the recording says that the run is complete, or has tripped, though the journal has lost it."""
    event = _recorded_end(session, entries)
    if event is not None and event.data.get("status") == Run.COMPLETE:
        raise SessionError(f"{directory}: its run is complete; there is nothing to resume")
    if tripped and not clear:
        raise SessionError(f"{directory}: the stand tripped: {tripped}; look into it, then resume with --clear")


def _recorded_begun(session: Session) -> Begun:
    """The first line of a journal that has lost it, from what the recording says; SessionError when it does not."""
    for event in session.events():
        plan, seed = event.data.get("plan"), event.data.get("seed")
        if event.kind in RUN_BEGINS and isinstance(plan, str) and isinstance(seed, int | None):
            texts = _text_hashes(session.attachments)
            return Begun(event.time_ns, session.metadata.get("session_id", ""), plan, texts, seed)
    raise SessionError(
        f"{session.path}: the line of its journal that says what was run is damaged, and the recording does not say "
        "it; begin a new run"
    )


def _order(session: Session, first: Begun) -> Order:
    """What was to be run, from the texts in the session; SessionError when they are not those the run began with."""
    texts = dict(session.attachments)
    if _text_hashes(texts) != first.texts:
        raise SessionError(f"{session.path}: the attached files are not those its run began with")
    order = parse_order(texts, {name: f"{session.path}: {name}" for name in texts})
    if plan_hash(order.recipe.plan()) != first.plan:
        raise SessionError(
            f"{session.path}: this version of thermostand makes another plan of its recipe; begin a new run"
        )
    return order


def journaled(entries: Iterable[Entry]) -> tuple[frozenset[str], dict[str, float]]:
    """The ids of the steps that are done, and what others, or soaks that began anew, have earned (s)."""
    done: set[str] = set()
    earned_s: dict[str, float] = {}
    for entry in entries:
        match entry:
            case Dwell():
                earned_s[entry.step_id] = entry.earned_s
            case Step(state="done"):
                done.add(entry.step_id)
                earned_s.pop(entry.step_id, None)
            case Again():
                done.difference_update(entry.step_ids)
            case _:
                pass
    return frozenset(done), earned_s


def _begun_steps(entries: Iterable[Entry]) -> set[str]:
    """The ids of the steps that were begun, done or not."""
    begun: set[str] = set()
    for entry in entries:
        if isinstance(entry, Step):
            begun.add(entry.step_id)
        if isinstance(entry, Again):
            begun.difference_update(entry.step_ids)
    return begun


@dataclass(frozen=True, slots=True)
class _Found:
    """again: ids of steps to be done again, the capture last. superseded: how many frames that capture had."""

    progress: Progress
    again: tuple[str, ...]
    superseded: int


def _found(session: Session, entries: Sequence[Entry], recipe: Recipe) -> _Found:
    """What counts as done; of a warm-up that was interrupted nothing does from its cold start on."""
    since_ns = begins_of(session)  # what the journal says of it, too, unless that is damaged
    since_ns |= {step_id: entry.time_ns for entry in entries if isinstance(entry, Again) for step_id in entry.step_ids}
    done, earned_s = journaled(entries)
    recorded = (mark for mark in session.steps() if mark.time_ns >= since_ns.get(mark.step_id, 0))
    done |= {mark.step_id for mark in recorded if mark.state is StepState.DONE}
    again = tuple(planned.step_id for planned in cold_start(recipe.plan(), done, _begun_steps(entries)))
    begun = {planned.step_id for planned in recipe.plan() if isinstance(planned.step, Capture)} - done
    frames = _frames(session, begun, since_ns)
    superseded = frames.pop(again[-1], 0) if again else 0
    return _Found(Progress(done - frozenset(again), earned_s, frames), again, superseded)


def _frames(session: Session, step_ids: set[str], since_ns: Mapping[str, int]) -> dict[str, int]:
    """How many frames of these steps are on the disk with their descriptions, each counted from its instant on."""
    times_ns = set(session.frame_times_ns.tolist())
    counts: dict[str, int] = {}
    for time_ns, meta in session.frame_metas:
        if meta.step_id in step_ids and time_ns in times_ns and time_ns >= since_ns.get(meta.step_id, 0):
            counts[meta.step_id] = counts.get(meta.step_id, 0) + 1
    return counts
