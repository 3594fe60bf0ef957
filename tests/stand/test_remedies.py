"""Each warning and error that the program publishes has a line that says what to type or to look at."""

import ast
from functools import cache
from pathlib import Path

import pytest

import stand.watching.remedies as remedies
from recording.format.restarts import KIND as RESTARTED
from recording.format.utc_offsets import CLOCK_STEP
from recording.reading.contents import PLAN_CHANGED, RUN_END
from stand.imaging.equilibrium import LOST
from stand.running.executing.camera_gap import CHANGED
from stand.running.opening.clock_watch import HOST_SUSPENDED
from stand.serving.alert_book import RUN_FAILED
from stand.watching.remedies import next_command

ROOT = Path(remedies.__file__).parents[2]
ROOMS = ("stand", "recording", "drivers/devices", "foundation")
LEVELS = ("warning", "error")
GENERIC = next_command("of a later version", {})

# Kinds that stand in a constant, or are handed over by who publishes them.
NAMED = {
    "CLOCK_STEP": CLOCK_STEP,
    "HOST_SUSPENDED": HOST_SUSPENDED,
    "KIND": RESTARTED,
    "LOST": LOST,
    "PLAN_CHANGED": PLAN_CHANGED,
    "RUN_END": RUN_END,
    "RUN_FAILED": RUN_FAILED,
}
HANDED_OVER = {
    CHANGED,
    PLAN_CHANGED,
    RUN_END,
    "compressor_dropped",
    "compressor_not_on",
    "heater_enable_dropped",
    "heater_enable_not_on",
    "interface_failed",
    "left_on",
    "permit_not_renewed",
    "soak_restarted",
    "switched_off",
}


@cache
def calls() -> tuple[ast.Call, ...]:
    """Of the files that publish anything."""
    paths = [path for room in ROOMS for path in sorted((ROOT / room).rglob("*.py"))]
    texts = [text for path in paths if any(f'"{each}"' in (text := path.read_text("utf-8")) for each in LEVELS)]
    texts += [path.read_text("utf-8") for path in sorted((ROOT / "stand" / "guarding").glob("*.py"))]
    return tuple(node for text in texts for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call))


def published() -> set[str]:
    """What follows a level among the arguments of a call of `Event`, `Notice` or something that tells."""
    found: set[str] = set()
    for call in calls():
        name = ast.unparse(call.func).rpartition(".")[2]
        if name not in ("Event", "Notice", "tell", "_tell", "_event"):
            continue
        for level, kind in zip(call.args, call.args[1:], strict=False):
            levels = [level.body, level.orelse] if isinstance(level, ast.IfExp) else [level]
            if not any(isinstance(each, ast.Constant) and each.value in LEVELS for each in levels):
                continue
            match kind:
                case ast.Constant(str(value)):
                    found.add(value)
                case ast.Name(id=constant) if constant.isupper():
                    found.add(NAMED[constant])
                case _:
                    pass  # one of HANDED_OVER, or a rule of the guard
    return found


@cache
def rules() -> set[str]:
    """Names of the guard's."""
    return {
        str(call.args[0].value)
        for call in calls()
        if ast.unparse(call.func) == "Fault" and isinstance(call.args[0], ast.Constant)
    }


KINDS = sorted(published() | HANDED_OVER)


def test_the_kinds_that_are_published_were_found():
    assert {"device_lost", "frames_dropped", "pictures_lost", "prompt", CLOCK_STEP, RESTARTED} <= set(KINDS)
    assert len(KINDS) > 70


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_has_a_line_of_its_own(kind: str):
    reported = next_command(kind, {"status": "stopped"}, "/data/a night")
    assert reported != GENERIC
    assert "{" not in reported
    assert "DIR" not in reported


@pytest.mark.parametrize("rule", remedies._OF_RULE)
def test_rules_that_only_warn_have_theirs(rule: str):
    assert rule in rules()
    assert next_command(f"guard.{rule}", {"action": "warn"}) != GENERIC


def test_no_line_is_of_a_kind_that_nobody_publishes():
    assert set(remedies._OF_KIND) - set(KINDS) == set()
