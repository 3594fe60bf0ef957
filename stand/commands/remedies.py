"""What to type after a message, so that its reader need not look it up: at the terminal, and as a page of the site."""

from __future__ import annotations

import inspect
from collections.abc import Mapping

from thermostand.foundation.events import GUARD, KINDS, EventKind, advice_for
from thermostand.stand import gate as gate
from thermostand.stand.guarding import guard as guard
from thermostand.stand.guarding import rules as rules  # these three register rows of their own

_HEAD = """# Troubleshooting

What a stand says, and what helps: the events of a session, made from the rows of `foundation/events.py`. A warning or
an error is shown with its advice. `alert`: the cause of the message to people elsewhere (`alerts.causes`).

| event | level | what it says | what to do | alert |
|---|---|---|---|---|
"""


_ACTIONS = ({"action": "abort"}, {"action": "hold"}, {"action": "hold", "ends_itself": True})


def next_command(kind: str, data: Mapping[str, object], session: str = "") -> str:
    """What helps, or shows more, after a warning or an error of that kind. session: the folder of the run's."""
    return advice_for(kind, data, session)


def rows() -> list[EventKind]:
    """Every kind there is, the guard's rules included, by name."""
    return sorted(KINDS.values())


def troubleshooting() -> str:
    """A page with a line for each kind of event, and for each of the cases in which it differs. What follows a rule of
    the guard depends on its action, whichever rule it is."""
    others, guards = [[row for row in rows() if row.startswith(GUARD) is is_rule] for is_rule in (False, True)]
    lines = [_line(_name(row, case), row, case, _says(row)) for row in others for case in row.cases]
    lines += [_line(_name(f"{GUARD}*", case), guards[0], case, "what the rule objects to") for case in _ACTIONS]
    lines += [_line(f"`{row}` that only warns", row, {"action": "warn"}, _says(row)) for row in guards]
    return _HEAD + "".join(lines)


def _name(name: str, case: Mapping[str, object]) -> str:
    when = ", ".join(f"{key} {value}" for key, value in case.items())
    return f"`{name}`{f' ({when})' if when else ''}"


def _says(row: EventKind) -> str:
    return row.text if isinstance(row.text, str) else inspect.getdoc(row.text) or ""


def _line(name: str, row: EventKind, case: Mapping[str, object], says: str) -> str:
    alert, level = row.alert_of(case), row.level_of(case)
    advice = "" if level == "info" else advice_for(row, case)
    told = "" if alert is None else f"{alert.cause}, over" if alert.phase == "over" else alert.cause
    return f"| {name} | {level} | {says} | {advice} | {told} |\n"
