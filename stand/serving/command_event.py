"""What the recording keeps of a command."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import JsonValue

from foundation.items import Event
from stand.serving.desk import Verb, Who

COMMAND = "command"  # the kind of the event that each command is


def command_event(
    time_ns: int, who: Who, verb: Verb, arguments: Mapping[str, JsonValue], result: str = "done"
) -> Event:
    """What the recording keeps of a command: who, how, what, and what came of it."""
    by = who.name or "somebody"
    data = {"who": who.name, "how": who.how, "verb": verb, "arguments": dict(arguments), "result": result}
    ending = "" if result == "done" else f": {result}"
    return Event(time_ns, "info", COMMAND, f"{by} ({who.how}): {_in_words(verb, arguments)}{ending}", data)


def _in_words(verb: Verb, arguments: Mapping[str, JsonValue]) -> str:
    """`pause`, `skip step_id=0-soak`, `flap open`, `linear move position=12.0`."""
    given = arguments.get("arguments")
    if verb == "device" and isinstance(given, Mapping):
        return " ".join([str(arguments.get("device")), str(arguments.get("verb")), *_pairs(given)])
    return " ".join([verb, *_pairs({name: value for name, value in arguments.items() if name != "key"})])


def _pairs(arguments: Mapping[str, JsonValue]) -> list[str]:
    return [f"{name}={value}" for name, value in arguments.items() if value not in ("", [], None)]
