"""What to type after a message, so that its reader need not look it up: at the terminal, and as a page of the site."""

from __future__ import annotations

import inspect
from collections.abc import Mapping

from thermostand.foundation.events import GUARD, KINDS, EventKind, get_advice
from thermostand.stand.guarding import guard as guard
from thermostand.stand.guarding import rules as rules  # these three register rows of their own
from thermostand.stand.safety import gate as gate

_HEAD = """# Troubleshooting

What a stand says, and what helps: the events of a session, made from the rows of `foundation/events.py`. A warning or
an error is shown with its advice. `alert`: the cause of the message to people elsewhere (`alerts.causes`).

| event | level | what it says | what to do | alert |
|---|---|---|---|---|
"""


_ACTIONS = ({"action": "abort"}, {"action": "hold"}, {"action": "hold", "ends_itself": True})


def get_next_command(kind: str, data: Mapping[str, object], session: str = "") -> str:
    """Return what helps, or shows more, after a warning or an error of that kind. session: the folder of the run's."""
    return get_advice(kind, data, session)


def list_event_kinds() -> list[EventKind]:
    """Every kind there is, the guard's rules included, by name."""
    return sorted(KINDS.values())


def make_troubleshooting_page() -> str:
    """A page with a line for each kind of event, and for each of the cases in which it differs. What follows a rule of
    the guard depends on its action, whichever rule it is."""
    others, guards = [
        [row for row in list_event_kinds() if row.startswith(GUARD) is is_rule] for is_rule in (False, True)
    ]
    lines = [
        _format_line(_format_name(row, case), row, case, _describe_kind(row)) for row in others for case in row.cases
    ]
    lines += [
        _format_line(_format_name(f"{GUARD}*", case), guards[0], case, "what the rule objects to") for case in _ACTIONS
    ]
    lines += [_format_line(f"`{row}` that only warns", row, {"action": "warn"}, _describe_kind(row)) for row in guards]
    return _HEAD + "".join(lines)


def _format_name(name: str, case: Mapping[str, object]) -> str:
    when = ", ".join(f"{key} {value}" for key, value in case.items())
    return f"`{name}`{f' ({when})' if when else ''}"


def _describe_kind(row: EventKind) -> str:
    return row.text if isinstance(row.text, str) else inspect.getdoc(row.text) or ""


def _format_line(name: str, row: EventKind, case: Mapping[str, object], says: str) -> str:
    alert, level = row.make_alert(case), row.get_level(case)
    advice = "" if level == "info" else get_advice(row, case)
    named = "" if alert is None else f"{alert.cause}, over" if alert.phase == "over" else alert.cause
    return f"| {name} | {level} | {says} | {advice} | {named} |\n"
