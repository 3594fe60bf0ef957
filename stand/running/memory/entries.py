"""What happens to a run, entry by entry. RunState is folded from them; those that outlive the daemon are lines of its
journal (recording/format/journal_lines.py).

    Begun        the run, its plan and the texts it was made of; the first line and no other
    StepChanged  a step was started, or is done
    Soaked        soak time so far
    Held         a reason to wait appeared or went
    Gap          nothing ran between two instants
    Again        steps that were done are to be done again
    Skipped      a step is left out, or broken off, by an operator
    Extended     a soak is made longer by an operator
    Edited       the steps from a place on are replaced, by an operator or by the plan's own decision
    Tripped      the guard has made the stand safe, and why
    Reset        an operator has removed the cause of a trip
    Ended        complete, stopped by the operator, tripped, or failed

Not written: what the recording proves (Taken, Cooled), and what a Gap makes void (Due, Preparing, Restored).

    Taken        a capture has a frame more
    Due          when the capture's next frame is due
    Preparing    the stand is being made ready for the next step, or is
    Restored     the set-up of the steps so far has been brought about again
    Cooled       the camera was or may have been off

Instants are ns on the stand's clock, so a run in virtual time has the same journal each time.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, asdict, dataclass, fields
from functools import cache
from typing import Literal, cast

from pydantic import TypeAdapter, ValidationError

from thermostand.experiments.steps import Step
from thermostand.foundation.document_faults import format_path
from thermostand.foundation.errors import SessionError
from thermostand.recording.format.journal_lines import JOURNAL_NAME


@dataclass(frozen=True, slots=True)
class Begun:
    """run: the session's name. plan: hash of the steps' ids. texts: hash of each attached text by its name.
    seed: of the simulated laboratory, None when it was the configured one."""

    time_ns: int
    run: str
    plan: str
    texts: dict[str, str]
    seed: int | None = None


@dataclass(frozen=True, slots=True)
class StepChanged:
    """A step of the plan; "done" is written when all it has recorded is on the disk."""

    time_ns: int
    step_id: str
    state: Literal["started", "done"]


@dataclass(frozen=True, slots=True)
class Soaked:
    """A soak has lasted `soaked_s`; also after its end, when it has to be repeated. ended: once it has, with the
    chamber in its band or without."""

    time_ns: int
    step_id: str
    soaked_s: float
    ended: Literal["", "settled", "unsettled"] = ""


@dataclass(frozen=True, slots=True)
class Held:
    """`reason` holds the run from now on, or (`held` false) does not any more."""

    time_ns: int
    reason: str
    held: bool


@dataclass(frozen=True, slots=True)
class Gap:
    """Nothing was recorded, and nobody watched the stand, between these instants."""

    from_ns: int
    time_ns: int


@dataclass(frozen=True, slots=True)
class Restarted:
    """These steps count as neither begun nor done from now on, and no frame of theirs before counts. frames_lost: by
    the disk, when it is for them."""

    time_ns: int
    step_ids: list[str]
    frames_lost: int = 0


@dataclass(frozen=True, slots=True)
class Skipped:
    """The step is not done, or not to its end, and the run continues behind it; its frames so far count."""

    time_ns: int
    step_id: str


@dataclass(frozen=True, slots=True)
class Extended:
    """The soak takes so much longer."""

    time_ns: int
    step_id: str
    by_s: float


@dataclass(frozen=True, slots=True)
class Edited:
    """The steps from the place `from_index` on are these instead, each its kind and its parameters (JSON-able).

    decided: the id of the step `Decide` whose decision this is, "" for an operator's change. reason: for a decision.
    """

    time_ns: int
    from_index: int
    by: list[dict[str, object]]
    decided: str = ""
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Tripped:
    """The guard has made the stand safe; nothing is done before an operator has reset it."""

    time_ns: int
    rule: str
    text: str


@dataclass(frozen=True, slots=True)
class Reset:
    """An operator has removed the cause of a trip."""

    time_ns: int


@dataclass(frozen=True, slots=True)
class Ended:
    """How the run ended, and why."""

    time_ns: int
    status: Literal["complete", "stopped", "tripped", "failed"]
    text: str


@dataclass(frozen=True, slots=True)
class Taken:
    """A frame of the capture, exposed at this instant."""

    time_ns: int
    step_id: str


@dataclass(frozen=True, slots=True)
class Due:
    """The next frame of the capture under way is due then, None when its deadlines start again. lost: the camera did
    not give the last one."""

    time_ns: int
    due_ns: int | None
    lost: bool = False


@dataclass(frozen=True, slots=True)
class Preparing:
    """The stand is being made ready from now on (`begins`) or was until now."""

    time_ns: int
    begins: bool


@dataclass(frozen=True, slots=True)
class Restored:
    """What the first `disturbances` of the run had undone is as it was."""

    time_ns: int
    setup_invalidations: int


@dataclass(frozen=True, slots=True)
class Cooled:
    """The camera was or may have been off."""

    time_ns: int


JournalEntry = (
    Begun | StepChanged | Soaked | Held | Gap | Restarted | Skipped | Extended | Edited | Tripped | Reset | Ended
)
Entry = JournalEntry | Taken | Due | Preparing | Restored | Cooled
Change = Skipped | Extended | Edited  # of the plan

_ENTRY_CLASSES: dict[str, type[JournalEntry]] = {"Step": StepChanged} | {
    kind.__name__: kind
    for kind in (Begun, Soaked, Held, Gap, Restarted, Skipped, Extended, Edited, Tripped, Reset, Ended)
}
_NAMES = {kind: name for name, kind in _ENTRY_CLASSES.items()}


def make_edit(time_ns: int, from_index: int, steps: Iterable[Step], decided: str = "", reason: str = "") -> Edited:
    """The steps from a place on replaced by these."""
    by: list[dict[str, object]] = [{"kind": step.kind, "parameters": step.parameters} for step in steps]
    return Edited(time_ns, from_index, by, decided, reason)


_CHANGES: dict[object, type[Change]] = {kind.__name__: kind for kind in (Skipped, Extended, Edited)}


def make_change_data(change: Change) -> dict[str, object]:
    """The change of a plan as the recording has it, but for its instant and what an operator's change has none of."""
    left_out = {each.name for each in fields(change) if getattr(change, each.name) == each.default} | {"time_ns"}
    return {"change": type(change).__name__, **{name: v for name, v in asdict(change).items() if name not in left_out}}


def parse_change(time_ns: int, data: Mapping[str, object]) -> Change | None:
    """The change that `make_change_data` has given, among other fields; None when there is none."""
    kind = _CHANGES.get(data.get("change"))
    if kind is None:
        return None
    names = [each.name for each in fields(kind) if each.name != "time_ns"]
    optional = {each.name for each in fields(kind) if each.default is not MISSING}
    try:
        return kind(time_ns, **{name: data[name] for name in names if name in data or name not in optional})  # pyright: ignore[reportArgumentType] - as written
    except LookupError:
        return None


def encode(entry: JournalEntry) -> bytes:
    """Return what its line says."""
    return json.dumps({"entry": _NAMES[type(entry)], **asdict(entry)}).encode()


def decode(text: bytes) -> JournalEntry:
    """The entry in a sound line; SessionError when it is not known here, or holds values of other types."""
    try:
        values = cast("dict[str, object]", json.loads(text))
        return _adapter(cast("str", values.pop("entry"))).validate_python(values)
    except ValidationError as error:
        wrong = "; ".join(f"{format_path(fault['loc'])}: {fault['msg']}" for fault in error.errors())
        if any(fault["type"] in ("missing", "unexpected_keyword_argument") for fault in error.errors()):
            raise SessionError(f"{JOURNAL_NAME}: an entry is of another version of thermostand ({wrong})") from error
        raise SessionError(f"{JOURNAL_NAME}: no run has written such entries ({wrong}); begin a new run") from error
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise SessionError(f"{JOURNAL_NAME}: an entry is of another version of thermostand ({text[:80]!r})") from error


@cache
def _adapter(name: str) -> TypeAdapter[JournalEntry]:
    """Checks the values of the entries of this name; LookupError when there are none."""
    return TypeAdapter(_ENTRY_CLASSES[name])
