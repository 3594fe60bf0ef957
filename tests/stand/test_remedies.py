"""Each kind of event is a row of one table, from which the rest follows, also one that somebody else adds."""

import ast
import inspect
from collections.abc import Iterator
from pathlib import Path
from string import Formatter

import pytest

from thermostand import stand
from thermostand.foundation import events
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.events import GUARD, KINDS, Alert, EventKind, event, guard_rule, make_alert
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event
from thermostand.foundation.repeat_limit import RepeatLimit
from thermostand.stand.commands.remedies import get_next_command, make_troubleshooting_page
from thermostand.stand.commands.status_snapshot import format_event
from thermostand.stand.safety import gate
from thermostand.stand.serving.alerts import AlertTracker

ROOT = Path(stand.__file__).parents[1]
GENERIC = get_next_command("of a later version", {})


@pytest.fixture
def lamp():
    """A kind that a package from outside brings."""
    yield event(
        "lamp.broken",
        "warning",
        "{lamp} has gone out after {lit_s:min} min: {text}",
        "exchange {folder}'s lamp",
        alert=Alert("device_lost", "lamp", "lasting"),
        counts=True,
    )
    del KINDS["lamp.broken"]


def published(*events: Event) -> list[Event]:
    """What the hub of a stand lets through."""
    hub, seen = Hub(RepeatLimit()), list[Event]()
    hub.subscribe(lambda item: seen.append(item) if isinstance(item, Event) else None)
    for each in events:
        hub.publish(each)
    return seen


def test_a_kind_that_is_added_is_found_everywhere(lamp: EventKind):
    (seen,) = published(lamp.at(5 * NS_PER_S, "no current", lamp="lamp 2", lit_s=720.0))
    sentence = "lamp 2 has gone out after 12 min: no current"
    assert seen == Event(5 * NS_PER_S, "warning", "lamp.broken", sentence, {"lamp": "lamp 2", "lit_s": 720.0})
    assert get_next_command(seen.kind, seen.data, "/a night") == "exchange '/a night''s lamp"
    line = format_event({**vars_of(seen), "utc_offset_ns": 0}, "/n")
    assert line == f"warning: 1970-01-01 00:00:05 UTC  {sentence}; exchange /n's lamp"
    book = AlertTracker("lab", ("device_lost",), 60 * NS_PER_S, 20)
    assert book.receive(seen, seen.time_ns) == []
    assert [each.text for each in book.due(65 * NS_PER_S)] == [sentence]
    assert len(published(*[lamp.at(second, lamp="1", lit_s=1.0) for second in range(50)])) == 50
    row = next(line for line in make_troubleshooting_page().splitlines() if "`lamp.broken`" in line)
    assert [cell.strip() for cell in row.strip("|").split(" | ")[1:]] == [
        "warning",
        "{lamp} has gone out after {lit_s:min} min: {text}",
        "exchange DIR's lamp",
        "device_lost",
    ]


def vars_of(seen: Event) -> dict[str, object]:
    return {"time_ns": seen.time_ns, "level": seen.level, "kind": seen.kind, "text": seen.text, "data": seen.data}


def test_a_rule_of_the_guard_that_is_added_has_its_row():
    name = guard_rule("too_loud", "the fan", "oil it")
    try:
        kind = KINDS[GUARD + name]
        trip, warning = (kind.at(0, "85 dB", rule=name, action=action) for action in ("abort", "warn"))
        assert (trip.level, warning.level, trip.text) == ("error", "warning", "85 dB")
        assert (make_alert(trip), make_alert(warning)) == (Alert("trip", "guard"), None)
        assert get_next_command(warning.kind, warning.data) == "oil it"
        assert "| `guard.too_loud` that only warns | warning | the fan | oil it |" in make_troubleshooting_page()
    finally:
        del KINDS[GUARD + name]


@pytest.mark.parametrize(
    "data", [{}, {"lamp": "left"}, {"lamp": "left", "lit_s": "long"}, {"lamp": "left", "lit_s": None}]
)
def test_a_text_that_cannot_be_made_loses_no_event(lamp: EventKind, data: dict[str, object]):
    reported = lamp.at(7, "the fuse", **data)
    assert (reported.time_ns, reported.level, reported.kind, reported.data) == (7, "warning", "lamp.broken", data)
    assert reported.text == ", ".join(["the fuse", *(f"{name} {value}" for name, value in data.items())])


def test_a_name_is_taken_once():
    with pytest.raises(ValueError, match="device_lost"):
        event("device_lost", "info", "again")


@pytest.mark.parametrize("kind", [row for row in KINDS.values() if not row.startswith(GUARD)])
def test_each_warning_and_error_has_advice_of_its_own(kind: EventKind):
    for case in kind.cases:
        if kind.get_level(case) != "info":
            advice = get_next_command(kind, {"status": "stopped", **case}, "/data/a night")
            assert advice != GENERIC
            assert "{" not in advice
            assert "DIR" not in advice


def test_each_rule_that_trips_has_a_row():
    named = [
        call.args[0]
        for path in sorted((ROOT / "stand").rglob("*.py"))
        for call in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(call, ast.Call) and ast.unparse(call.func) == "Fault" and call.args
    ]
    assert [ast.unparse(each) for each in named if isinstance(each, ast.Constant)] == []


FOLDERS = ("stand", "recording", "drivers/devices", "drivers/settings.py", "foundation", "experiments", "compensation")
TREES = {
    path: ast.parse(text)
    for folder in FOLDERS
    for path in ([ROOT / folder] if folder.endswith(".py") else sorted((ROOT / folder).rglob("*.py")))
    if "thermostand.foundation.events" in (text := path.read_text("utf-8")) or "Event(" in text
}
NAMED = {name: row for name, row in vars(events).items() if isinstance(row, EventKind)} | {
    "HELD": gate.HELD,
    "RELEASED": gate.RELEASED,
}


def fields_of(row: EventKind) -> set[str]:
    """What its text needs."""
    if isinstance(row.text, str):
        return {name.partition("[")[0] for _, name, _, _ in Formatter().parse(row.text) if name}
    of = inspect.signature(row.text).parameters.values()
    return {each.name for each in of if each.default is each.empty and each.kind is each.POSITIONAL_OR_KEYWORD}


def sites() -> Iterator[tuple[EventKind, set[str], str]]:
    """Each row that is published by its name, with the fields that it is given there; data that come as a whole are
    not followed."""
    for path, tree in TREES.items():
        for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
            match call:
                case ast.Call(func=ast.Attribute(value=ast.Name(id=name), attr="at")) if name in NAMED:
                    given = call.args[1:]
                case ast.Call(func=ast.Attribute(attr="tell" | "_tell"), args=[ast.Name(id=name), *given]) if (
                    name in NAMED
                ):
                    pass
                case _:
                    continue
            if all(keyword.arg for keyword in call.keywords):
                yield (
                    NAMED[name],
                    {str(keyword.arg) for keyword in call.keywords} | ({"text"} if given else set()),
                    f"{path.name}:{call.lineno}",
                )


def test_each_site_gives_what_the_text_of_its_row_needs():
    seen = list(sites())
    assert [(row, where) for row, given, where in seen if not fields_of(row) - {"text"} <= given] == []
    assert len({row for row, _, _ in seen}) > 70


def test_no_other_place_makes_an_event():
    made = {
        str(path.relative_to(ROOT))
        for path, tree in TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "Event" and node.args
    }
    assert made == {"foundation/events.py", "recording/format/messages.py"}  # the latter is one that was recorded


def test_each_row_is_used():
    elsewhere = {
        name.id
        for path, tree in TREES.items()
        if path.name != "events.py"
        for name in ast.walk(tree)
        if isinstance(name, ast.Name)
    }
    assert sorted(name for name in set(NAMED) - elsewhere) == []
