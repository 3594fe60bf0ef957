"""What cases have reached of all that there is, so that what is never reached is seen."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, get_args

from tests.torture.case import KINDS, ORDERS
from tests.torture.real import KINDS as REAL
from tests.torture.rig import Result
from thermostand.drivers.sim.laboratory_faults import FAULTS
from thermostand.foundation.events import GUARD
from thermostand.stand.commands.remedies import list_event_kinds
from thermostand.stand.running.memory.entries import JournalEntry

SITUATIONS = ("between", "soak", "capture", "step", "held", "tripped", "ended")
"""Of a run, as its journal shows them: what is under way, or why nothing is."""
_AT_AN_END, _OF_A_TRIP = {"Gap", "Reset", "Tripped"}, {"Reset"}


class Reached:
    """How often each was: kinds of faults and orders, rules of the guard, kinds of events, entries of the journal, each
    also in each situation of a run (the rows of its table), and ends of the program."""

    def __init__(self, *, is_real: bool = False) -> None:
        self._known = list_everything(is_real=is_real)
        self.counts: dict[str, Counter[str]] = {
            name: Counter() for name in ("kinds", "rules", "events", "entries", "rows", "ends")
        }

    def add(self, result: Result) -> None:
        """What a case has reached."""
        case, counts = result.case, self.counts
        counts["kinds"].update(fault.name for fault in case.faults)
        counts["kinds"].update(order.verb for order in case.orders)
        counts["kinds"].update({"kill": len(case.kills_s)})
        counts["rules"].update(result.rules)
        counts["events"].update(result.events)
        counts["entries"].update(str(entry["entry"]) for entry in result.journal)
        counts["rows"].update(iterate_rows(result.journal, result.steps))
        counts["ends"].update(str(life.status) for life in result.lives)

    def format_lines(self) -> Iterator[str]:
        """Two lines for each: what was, and what was not."""
        known = self._known
        for name, counts in self.counts.items():
            yield f"{name}: {', '.join(f'{each} {number}' for each, number in counts.most_common())}"
            if missing := sorted(set(known.get(name, ())) - counts.keys()):
                yield f"{name} never reached ({len(missing)} of {len(known[name])}): {', '.join(missing)}"


def list_everything(*, is_real: bool) -> Mapping[str, set[str]]:
    """All that there is in that leg, as the tables name it."""
    own = {each.__name__ for each in get_args(JournalEntry)}
    during = {f"{each}: {entry}" for each in SITUATIONS[:-1] for entry in own - {"Begun"}}
    misplaced = {f"{each}: {entry}" for each in SITUATIONS[:-2] for entry in _OF_A_TRIP}
    return {
        "kinds": {"kill", *(REAL.keys() | FAULTS.keys() if is_real else KINDS.keys() | set(ORDERS))},
        "rules": {row.removeprefix(GUARD) for row in list_event_kinds() if row.startswith(GUARD)},
        "events": {row for row in list_event_kinds() if not row.startswith(GUARD)},
        "entries": own,
        "rows": {"between: Begun", *(f"ended: {entry}" for entry in _AT_AN_END), *during} - misplaced,
    }


def iterate_rows(journal: Sequence[Mapping[str, Any]], steps: Mapping[str, str]) -> Iterator[str]:
    """In which situation each entry was written. steps: the kind of each step by its id."""
    under_way, held, ended, tripped = "", set[str](), False, False
    for entry in journal:
        name, kind = str(entry["entry"]), steps.get(under_way, "step")
        doing = next((each for each in ("soak", "capture") if each in kind.lower()), "step") if under_way else "between"
        yield f"{'ended' if ended else 'tripped' if tripped else 'held' if held else doing}: {name}"
        match name:
            case "Step":
                under_way = str(entry["step_id"]) if entry["state"] == "started" else ""
            case "Skipped" | "Restarted" if under_way in (entry.get("step_id"), *entry.get("step_ids", ())):
                under_way = ""
            case "Held":
                held = held | {entry["reason"]} if entry["held"] else held - {entry["reason"]}
            case "Tripped" | "Reset":
                tripped = name == "Tripped"
            case "Ended" | "Gap":
                under_way, held, ended = "", set[str](), name == "Ended"
            case _:
                pass
