"""What cases have reached of all that there is, so that what is never reached is seen."""

from __future__ import annotations

import inspect
from collections import Counter
from collections.abc import Iterator, Mapping

from drivers.sim.laboratory_faults import FAULTS
from foundation.events import GUARD
from stand.running.memory import entries
from stand.watching.remedies import rows
from tests.torture.case import KINDS, ORDERS
from tests.torture.real import KINDS as REAL
from tests.torture.rig import Result


class Reached:
    """How often each was: kinds of faults and orders, rules of the guard, kinds of events, entries of the journal, and
    ends of the program."""

    def __init__(self, *, is_real: bool = False) -> None:
        self._known = everything(is_real=is_real)
        self.counts: dict[str, Counter[str]] = {
            name: Counter() for name in ("kinds", "rules", "events", "entries", "ends")
        }

    def add(self, result: Result) -> None:
        """What a case has reached."""
        case, counts = result.case, self.counts
        counts["kinds"].update(fault.name for fault in case.faults)
        counts["kinds"].update(order.verb for order in case.orders)
        counts["kinds"].update({"kill": len(case.kills_s)})
        counts["rules"].update(result.rules)
        counts["events"].update(result.events)
        counts["entries"].update(result.entries)
        counts["ends"].update(str(life.status) for life in result.lives)

    def told(self) -> Iterator[str]:
        """Two lines for each: what was, and what was not."""
        known = self._known
        for name, counts in self.counts.items():
            yield f"{name}: {', '.join(f'{each} {number}' for each, number in counts.most_common())}"
            if missing := sorted(set(known.get(name, ())) - counts.keys()):
                yield f"{name} never reached ({len(missing)} of {len(known[name])}): {', '.join(missing)}"


def everything(*, is_real: bool) -> Mapping[str, set[str]]:
    """All that there is in that leg, as the tables name it."""
    own = [
        each.__name__ for _, each in inspect.getmembers(entries, inspect.isclass) if each.__module__ == entries.__name__
    ]
    return {
        "kinds": {"kill", *(REAL.keys() | FAULTS.keys() if is_real else KINDS.keys() | set(ORDERS))},
        "rules": {row.removeprefix(GUARD) for row in rows() if row.startswith(GUARD)},
        "events": {row for row in rows() if not row.startswith(GUARD)},
        "entries": set(own),
    }
