"""Each kind of event is a row of one table, from which the rest follows, also one that somebody else adds."""

import ast
from pathlib import Path

import pytest

import stand
from foundation.clock import NS_PER_S
from foundation.events import GUARD, KINDS, Alert, EventKind, alert_of, event, guard_rule
from foundation.hub import Hub
from foundation.items import Event
from foundation.repeats import RepeatLimit
from stand.serving.alert_book import AlertBook
from stand.watching.remedies import next_command, troubleshooting
from stand.watching.there import event_line

ROOT = Path(stand.__file__).parents[1]
GENERIC = next_command("of a later version", {})


@pytest.fixture
def lamp():
    """A kind that a package from outside brings."""
    yield event(
        "lamp.broken",
        "warning",
        "{lamp} has gone out after {lit_s:min} min: {said}",
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
    said = "lamp 2 has gone out after 12 min: no current"
    assert seen == Event(5 * NS_PER_S, "warning", "lamp.broken", said, {"lamp": "lamp 2", "lit_s": 720.0})
    assert next_command(seen.kind, seen.data, "/a night") == "exchange '/a night''s lamp"
    line = event_line({**vars_of(seen), "utc_offset_ns": 0}, "/n")
    assert line.endswith(f"warning: {said}; exchange /n's lamp")
    book = AlertBook("lab", ("device_lost",), 60 * NS_PER_S, 20)
    assert book.receive(seen, seen.time_ns) == []
    assert [each.text for each in book.due(65 * NS_PER_S)] == [said]
    assert len(published(*[lamp.at(second, lamp="1", lit_s=1.0) for second in range(50)])) == 50
    row = next(line for line in troubleshooting().splitlines() if "`lamp.broken`" in line)
    assert [cell.strip() for cell in row.strip("|").split(" | ")[1:]] == [
        "warning",
        "{lamp} has gone out after {lit_s:min} min: {said}",
        "exchange DIR's lamp",
        "device_lost",
    ]


def vars_of(seen: Event) -> dict[str, object]:
    return {"time_ns": seen.time_ns, "level": seen.level, "kind": seen.kind, "text": seen.text, "data": seen.data}


def test_a_rule_of_the_guard_that_is_added_has_its_row():
    name = guard_rule("too_loud", "the fan is too loud", "oil it")
    try:
        kind = KINDS[GUARD + name]
        trip, warning = (kind.at(0, "85 dB", rule=name, action=action) for action in ("abort", "warn"))
        assert (trip.level, warning.level, trip.text) == ("error", "warning", "85 dB")
        assert (alert_of(trip), alert_of(warning)) == (Alert("trip", "guard"), None)
        assert next_command(warning.kind, warning.data) == "oil it"
        assert "| `guard.too_loud` that only warns | warning | the fan is too loud | oil it |" in troubleshooting()
    finally:
        del KINDS[GUARD + name]


def test_a_name_is_taken_once():
    with pytest.raises(ValueError, match="device_lost"):
        event("device_lost", "info", "again")


@pytest.mark.parametrize("kind", [row for row in KINDS.values() if not row.startswith(GUARD)])
def test_each_warning_and_error_has_advice_of_its_own(kind: EventKind):
    for case in kind.cases:
        if kind.level_of(case) != "info":
            advice = next_command(kind, {"status": "stopped", **case}, "/data/a night")
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
