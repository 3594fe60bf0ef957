"""What the recording keeps of a command."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import JsonValue

from thermostand.foundation.events import COMMAND
from thermostand.foundation.items import Event
from thermostand.stand.serving.desk import Verb, Who


def command_event(
    time_ns: int, who: Who, verb: Verb, arguments: Mapping[str, JsonValue], result: str = "done"
) -> Event:
    """What the recording keeps of a command: who, how, what, and what came of it."""
    data = {"who": who.name, "how": who.how, "verb": verb, "arguments": dict(arguments), "result": result}
    return COMMAND.at(time_ns, _in_words(verb, arguments), **data)


def _in_words(verb: Verb, arguments: Mapping[str, JsonValue]) -> str:
    """`pause`, `skip step_id=0-soak`, `flap open`, `linear move position=12.0`."""
    given = arguments.get("arguments")
    if verb == "device" and isinstance(given, Mapping):
        return " ".join([str(arguments.get("device")), str(arguments.get("verb")), *_pairs(given)])
    return " ".join([verb, *_pairs({name: value for name, value in arguments.items() if name != "key"})])


def _pairs(arguments: Mapping[str, JsonValue]) -> list[str]:
    return [f"{name}={value}" for name, value in arguments.items() if value not in ("", [], None)]
