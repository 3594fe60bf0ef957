"""A queue of runs that outlives the daemon: add, list, move, remove, and what a worker notes while it runs them.

Every function takes the recording directory, is whole on the disk when it returns, and may be called by several
processes at once. SessionError when the queue cannot be read or written, or a number is not in it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from thermostand.foundation.errors import SessionError, StandTripped
from thermostand.foundation.files import make_folder
from thermostand.stand.service.queue_file import Queue, QueueEntry, QueueState, change_queue, read_queue

if TYPE_CHECKING:
    from thermostand.stand.running.order import Order


def make_order(entry: QueueEntry) -> Order:
    """Return what an entry asks for; ConfigError when this version of the program refuses it."""
    # The process that touches the disk for a daemon loads this module, and needs none of that.
    from thermostand.stand.estimating.estimate import price_plan
    from thermostand.stand.running.order import load_register_maps, parse_order

    texts = {"config.yaml": entry.config_text, "recipe.yaml": entry.recipe_text, "target.yaml": entry.target_text}
    names = {"config.yaml": entry.config, "recipe.yaml": entry.recipe, "target.yaml": "its target"}
    order = parse_order(texts, {key: f"run {entry.id} of the queue: {name}" for key, name in names.items()})
    price_plan(order.recipe.plan(), order.config)
    return load_register_maps(order)


def load_queue(directory: Path) -> Queue:
    """The queue as it is now."""
    return read_queue(directory)


@dataclass(frozen=True, slots=True)
class RunOrigin:
    """Who asked for a run, and how: see queue_file.QueueEntry."""

    key: str = ""
    request: str = ""
    added_by: str = ""
    note: str = ""
    tags: tuple[str, ...] = ()


def make_entry(order: Order, config: str, now_ns: int, asked: RunOrigin = RunOrigin()) -> QueueEntry:
    """Return what is to be queued; `config` is the name of its configuration, for messages. Its number is given
    later."""
    return QueueEntry(
        id=1,
        recipe=order.recipe.name,
        config=config,
        config_text=order.config_text,
        recipe_text=order.recipe_text,
        target_text=order.target_text,
        added_ns=now_ns,
        attended=order.attended,
        **asdict(asked),
    )


def append(directory: Path, entry: QueueEntry) -> QueueEntry:
    """Queue it behind all others, with a number of its own. With the key of an earlier run: that one. SessionError
    when the request of that key was another."""
    make_folder(directory)
    with change_queue(directory) as draft:
        earlier = next((each for each in draft.queue.entries if entry.key and each.key == entry.key), None)
        if earlier is not None:
            if earlier.request != entry.request:
                raise SessionError(f"run {earlier.id} was asked for with this key, and it is another one")
            return earlier
        entry = entry.model_copy(update={"id": draft.queue.next_id})
        draft.set(next_id=entry.id + 1, entries=(*draft.queue.entries, entry))
    return entry


def move(directory: Path, number: int, position: int) -> None:
    """Make a run the `position`-th of those still to be done, 1 is the next; behind the last is the last."""
    if position < 1:
        raise SessionError(f"position {position}: the next run has position 1")
    with change_queue(directory) as draft:
        entry = draft.entry(number)
        if not entry.is_open:
            raise SessionError(f"run {number} is {entry.state}; only a run that is still to be done can be moved")
        rest = [other for other in draft.queue.entries if other.is_open and other.id != number]
        rest.insert(position - 1, entry)
        draft.set(entries=(*(other for other in draft.queue.entries if not other.is_open), *rest))


def remove(directory: Path, number: int) -> QueueEntry:
    """Take a run out of the queue, in any state but running; its session stays. SessionError when it is running."""
    with change_queue(directory) as draft:
        entry = draft.entry(number)
        if entry.state is QueueState.RUNNING:
            raise SessionError(f"run {number} is running; `stand stop` ends it")
        draft.set(entries=tuple(other for other in draft.queue.entries if other.id != number))
    return entry


def take(directory: Path, now_ns: int) -> QueueEntry | None:
    """The next run, marked as running, as it was before: an interrupted one has its session. None when all are done.

    StandTripped when the queue was halted and no operator has reset it.
    """
    with change_queue(directory) as draft:
        queue = draft.queue
        if queue.halted:
            remedy = "remove the cause, then `stand reset`"
            raise StandTripped(f"{directory}: the queue was halted: {queue.halted}; {remedy}")
        running = next((entry for entry in queue.entries if entry.state is QueueState.RUNNING), None)
        if running is not None:
            raise SessionError(f"run {running.id} is running; one at a time")
        entry = next((entry for entry in queue.entries if entry.is_open), None)
        if entry is not None:
            changes = {
                "state": QueueState.RUNNING,
                "began_ns": entry.began_ns if entry.session else now_ns,
                "reason": "",
                "fruitless_starts": entry.fruitless_starts + 1,
            }
            draft.put(entry.model_copy(update=changes))
    return entry


def note_session(directory: Path, number: int, session: Path) -> None:
    """The run has a session now; when it is interrupted it is resumed there."""
    with change_queue(directory) as draft:
        draft.put(draft.entry(number).model_copy(update={"session": session.name}))


def note_step(directory: Path, number: int) -> None:
    """The run under way has finished a step that it had not finished before."""
    with change_queue(directory) as draft:
        draft.put(draft.entry(number).model_copy(update={"fruitless_starts": 0}))


def finish(
    directory: Path, number: int, state: QueueState, now_ns: int, reason: str = "", *, halt: bool = False
) -> None:
    """The run under way has ended; with `halt` nothing is begun before an operator says so."""
    with change_queue(directory) as draft:
        changes = {"state": state, "ended_ns": now_ns, "reason": reason}
        if state is QueueState.INTERRUPTED:
            changes["fruitless_starts"] = 0  # by an operator, who may do so as often as he likes
        draft.put(draft.entry(number).model_copy(update=changes))
        if halt:
            draft.set(halted=f"run {number}: {reason}")


def halt(directory: Path, reason: str) -> None:
    """Halt the queue: nothing is begun before an operator resets it."""
    with change_queue(directory) as draft:
        draft.set(halted=draft.queue.halted or reason)


def prepend(directory: Path, entry: QueueEntry, session: str) -> QueueEntry:
    """Resume the run of that session next: an entry that has it is interrupted again, else `entry` is. What halted the
    queue is reset: an operator has asked for this."""
    with change_queue(directory) as draft:
        found = next((each for each in reversed(draft.queue.entries) if each.session == session), None)
        known: dict[str, object] = {"id": draft.queue.next_id, "began_ns": entry.added_ns}
        if found is not None:
            known = {"id": found.id, "added_ns": found.added_ns, "began_ns": found.began_ns, "attended": found.attended}
        entry = entry.model_copy(update={**known, "state": QueueState.INTERRUPTED, "session": session})
        rest = [each for each in draft.queue.entries if each.id != entry.id]
        ended, waiting = [e for e in rest if not e.is_open], [e for e in rest if e.is_open]
        draft.set(next_id=max(draft.queue.next_id, entry.id + 1), entries=(*ended, entry, *waiting), halted="")
    return entry


def reset(directory: Path) -> None:
    """An operator resets a halted queue."""
    with change_queue(directory) as draft:
        draft.set(halted="")
