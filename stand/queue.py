"""A queue of runs that outlives the daemon: add, list, move, remove, and what a worker notes while it runs them.

Every function takes the recording directory, is whole on the disk when it returns, and may be called by several
processes at once. SessionError when the queue cannot be read or written, or a number is not in it.
"""

from __future__ import annotations

from pathlib import Path

from compensation.target import Target
from drivers.documents import parse_document
from drivers.interface import SessionError, StandTripped
from drivers.registers import load_register_map
from stand.config import StandConfig, load_config, packaged
from stand.estimate import price
from stand.queue_file import Entry, Queue, State, changing, read_queue
from stand.recipe import Recipe, load_recipe
from stand.session_setup import Order


def load_order(recipe: str, config: str) -> Order:
    """The files (or installed names), read and checked as far as can be without the stand: ConfigError names what is
    wrong in which of them."""
    config_path, recipe_path = packaged("", config), packaged("recipes", recipe)
    stand_config, stand_recipe = load_config(config_path), load_recipe(recipe_path)
    target_path = packaged("targets", stand_config.target)
    texts = (path.read_text(encoding="utf-8") for path in (config_path, recipe_path, target_path))
    order = Order(stand_config, stand_recipe, *texts)
    parse_document(order.target_text, Target, str(target_path))
    for name in (stand_config.regulator.registers, stand_config.relays.registers, stand_config.thermometers.registers):
        load_register_map(packaged("registers", name))
    price(stand_recipe.plan(), stand_config)
    return order


def order_of(entry: Entry) -> Order:
    """What an entry asks for; ConfigError when this version of the program refuses it."""
    where = f"run {entry.id} of the queue: "
    order = Order(
        parse_document(entry.config_text, StandConfig, f"{where}{entry.config}"),
        parse_document(entry.recipe_text, Recipe, f"{where}{entry.recipe}"),
        entry.config_text,
        entry.recipe_text,
        entry.target_text,
    )
    price(order.recipe.plan(), order.config)
    return order


def queued(directory: Path) -> Queue:
    """The queue as it is now."""
    return read_queue(directory)


def add(directory: Path, order: Order, config: str, now_ns: int) -> Entry:
    """Queue a run behind all others; `config` is the name of its configuration, for messages."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SessionError(f"{directory}: cannot be made ({error.strerror})") from error
    with changing(directory) as draft:
        entry = Entry(
            id=draft.queue.next_id,
            recipe=order.recipe.name,
            config=config,
            config_text=order.config_text,
            recipe_text=order.recipe_text,
            target_text=order.target_text,
            added_ns=now_ns,
        )
        draft.set(next_id=entry.id + 1, entries=(*draft.queue.entries, entry))
    return entry


def move(directory: Path, number: int, position: int) -> None:
    """Make a run the `position`-th of those still to be done, 1 is the next; behind the last is the last."""
    if position < 1:
        raise SessionError(f"position {position}: the next run has position 1")
    with changing(directory) as draft:
        entry = draft.entry(number)
        if not entry.is_open:
            raise SessionError(f"run {number} is {entry.state}; only a run that is still to be done can be moved")
        rest = [other for other in draft.queue.entries if other.is_open and other.id != number]
        rest.insert(position - 1, entry)
        draft.set(entries=(*(other for other in draft.queue.entries if not other.is_open), *rest))


def remove(directory: Path, number: int) -> Entry:
    """Take a run out of the queue, whatever became of it; its session stays. SessionError when it is running."""
    with changing(directory) as draft:
        entry = draft.entry(number)
        if entry.state is State.RUNNING:
            raise SessionError(f"run {number} is running; `stand stop` ends it")
        draft.set(entries=tuple(other for other in draft.queue.entries if other.id != number))
    return entry


def take(directory: Path, now_ns: int) -> Entry | None:
    """The next run, marked as running, as it was before: an interrupted one has its session. None when all are done.

    StandTripped when the queue was halted and no operator has said that it may go on.
    """
    with changing(directory) as draft:
        queue = draft.queue
        if queue.halted:
            remedy = "see to it, then `stand queue start --clear`"
            raise StandTripped(f"{directory}: the queue was halted: {queue.halted}; {remedy}")
        running = next((entry for entry in queue.entries if entry.state is State.RUNNING), None)
        if running is not None:
            raise SessionError(f"run {running.id} is running; one at a time")
        entry = next((entry for entry in queue.entries if entry.is_open), None)
        if entry is not None:
            began_ns = entry.began_ns if entry.session else now_ns
            draft.put(entry.model_copy(update={"state": State.RUNNING, "began_ns": began_ns, "reason": ""}))
    return entry


def note_session(directory: Path, number: int, session: Path) -> None:
    """The run has a session now; when it is interrupted it is resumed there."""
    with changing(directory) as draft:
        draft.put(draft.entry(number).model_copy(update={"session": session.name}))


def finish(directory: Path, number: int, state: State, now_ns: int, reason: str = "", *, halt: bool = False) -> None:
    """The run under way has ended; with `halt` nothing is begun before an operator says so."""
    with changing(directory) as draft:
        entry = draft.entry(number)
        draft.put(entry.model_copy(update={"state": state, "ended_ns": now_ns, "reason": reason}))
        if halt:
            draft.set(halted=f"run {number}: {reason}")


def clear(directory: Path) -> None:
    """An operator says that a halted queue may go on."""
    with changing(directory) as draft:
        draft.set(halted="")
