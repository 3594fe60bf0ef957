"""The lines of SECoP 1.0 (specification, "Messages" and "Reports"): bytes in, requests out, and replies back. No I/O.

read chamber:value                ->  reply chamber:value [24.0, {"t": 1795416390.44}]
change chamber:target 300         ->  error_change chamber:target ["RangeError", "at most 60, not 300", {}]
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Literal, NoReturn, cast

from pydantic import JsonValue

IDENTIFICATION = "ISSE&SINE2020,SECoP,V2019-09-16,v1.0"  # clients compare the first two fields
IDENTIFY = "*IDN?"
LINE_LIMIT_BYTES = 1 << 14  # round number; nothing was measured
_ECHO = 200  # characters of what is not understood

# What each word asks for, and the word of its answer.
ANSWERS = {
    "describe": "describing",
    "activate": "active",
    "deactivate": "inactive",
    "read": "reply",
    "change": "changed",
    "do": "done",
    "ping": "pong",
    "help": "helping",
}

ErrorClass = Literal[
    "ProtocolError",
    "NoSuchModule",
    "NoSuchParameter",
    "NoSuchCommand",
    "ReadOnly",
    "WrongType",
    "RangeError",
    "BadJSON",
    "CommunicationFailed",
    "TimeoutError",
    "IsBusy",
    "Disabled",
    "Impossible",
    "ReadFailed",
    "HardwareError",
    "InternalError",
]


class Refusal(Exception):
    """What is answered instead of a value: SECoP's class of the error, and a sentence."""

    def __init__(self, error: ErrorClass, text: str) -> None:
        super().__init__(text)
        self.error: ErrorClass = error
        self.text = text

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Refusal) and (self.error, self.text) == (other.error, other.text)

    def __hash__(self) -> int:
        return hash((self.error, self.text))


@dataclass(frozen=True, slots=True)
class SecopRequest:
    """A line: `action [specifier [data]]`. data: JSON as it came, "" for none."""

    action: str
    specifier: str = ""
    data: str = ""

    @property
    def place(self) -> tuple[str, str]:
        """The module and its parameter or command, "" where there is none."""
        module, _, accessible = self.specifier.partition(":")
        return module, accessible.partition(":")[0]

    def value(self) -> JsonValue:
        """The data, None for none; Refusal when it is no JSON."""
        if not self.data.strip():
            return None
        try:
            return cast("JsonValue", json.loads(self.data, parse_constant=_no_number))
        except (ValueError, RecursionError):
            raise Refusal("BadJSON", "the data is no JSON value") from None


def parse_request(line: bytes) -> SecopRequest:
    """A line without its end; a CR before that is left out. An empty one asks for help. Refusal when it is no UTF-8."""
    try:
        text = line.removesuffix(b"\r").decode()
    except UnicodeDecodeError:
        raise Refusal("ProtocolError", "a line is UTF-8") from None
    action, _, rest = text.partition(" ")
    specifier, _, data = rest.partition(" ")
    return SecopRequest(action or "help", specifier, data)


def make_message(action: str, specifier: str = "", content: object = None) -> bytes:
    """A line with its end; `content` as JSON, none without it. NaN and infinities are a ValueError: SECoP has none."""
    words = action if content is None and not specifier else f"{action} {specifier}"
    if content is not None:
        words += f" {json.dumps(content, ensure_ascii=False, allow_nan=False)}"
    return words.encode("utf-8", "replace") + b"\n"


def make_report(value: object, t_s: float) -> list[object]:
    """A data report; t_s: when the value was obtained, s since the epoch, UTC."""
    return [value, {"t": round(t_s, 6)}]


def make_error_reply(request: SecopRequest, refusal: Refusal) -> bytes:
    """The answer to what is refused."""
    action = f"error_{request.action[:_ECHO]}"
    return make_message(action, request.specifier[:_ECHO], [refusal.error, refusal.text, {}])


def _no_number(text: str) -> NoReturn:
    raise ValueError(text)
