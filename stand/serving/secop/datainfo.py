"""SECoP's data types, as far as this node has them: what is published of a value, and whether a given one fits."""

from __future__ import annotations

import math
from collections.abc import Mapping

from pydantic import JsonValue

from thermostand.stand.serving.secop.secop_lines import Refusal

DataInfo = Mapping[str, JsonValue]
TEXT_LIMIT = 200  # round number; nothing was measured


def double(unit: str = "", minimum: float | None = None, maximum: float | None = None) -> DataInfo:
    """A number; the limits are inclusive."""
    given: dict[str, JsonValue] = {"unit": unit or None, "min": minimum, "max": maximum}
    return {"type": "double", **{name: value for name, value in given.items() if value is not None}}


def whole(maximum: int = 1 << 31) -> DataInfo:
    """A number of things."""
    return {"type": "int", "min": 0, "max": maximum}


def boolean() -> DataInfo:
    """True or false."""
    return {"type": "bool"}


def text() -> DataInfo:
    """A sentence or name in UTF-8."""
    return {"type": "string", "isUTF8": True}


def choice(members: Mapping[str, int]) -> DataInfo:
    """One of these, sent as its number."""
    return {"type": "enum", "members": dict(members)}


def status(members: Mapping[str, int]) -> DataInfo:
    """A status code and its sentence."""
    return {"type": "tuple", "members": [dict(choice(members)), dict(text())]}


def command(argument: DataInfo | None = None, result: DataInfo | None = None) -> DataInfo:
    """What is done, with at most one argument."""
    given = {"argument": argument, "result": result}
    return {"type": "command", **{name: dict(info) for name, info in given.items() if info is not None}}


def check_value(info: DataInfo, value: JsonValue) -> JsonValue:
    """The value, when it is of that type; Refusal WrongType or RangeError. An enum takes its names, too."""
    match info["type"]:
        case "double" | "int":
            return _check_number(info, value)
        case "string":
            return _check_string(value)
        case "enum":
            return _check_member(info, value)
        case kind:
            raise Refusal("WrongType", f"a {kind} is not taken")


def _check_number(info: DataInfo, value: JsonValue) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise Refusal("WrongType", "a number is needed")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    low, high = info.get("min"), info.get("max")
    if isinstance(low, int | float) and number < low:
        raise Refusal("RangeError", f"at least {low:g}, not {number:g}")
    if not math.isfinite(number) or (isinstance(high, int | float) and number > high):
        raise Refusal("RangeError", f"at most {high:g}, not {number:g}" if high is not None else "too large")
    if info["type"] == "int" and not number.is_integer():
        raise Refusal("WrongType", "a whole number is needed")
    return int(number) if info["type"] == "int" else number


def _check_string(value: JsonValue) -> str:
    if not isinstance(value, str):
        raise Refusal("WrongType", "a string is needed")
    if len(value) > TEXT_LIMIT:
        raise Refusal("RangeError", f"at most {TEXT_LIMIT} characters")
    return value


def _check_member(info: DataInfo, value: JsonValue) -> int:
    members = info["members"]
    if not isinstance(members, dict):
        raise TypeError("an enum has members")
    numbers = {name: number for name, number in members.items() if isinstance(number, int)}
    if isinstance(value, str) and value in numbers:
        return numbers[value]
    if isinstance(value, bool) or not isinstance(value, int):
        raise Refusal("WrongType", f"one of {', '.join(numbers)} is needed")
    if value not in numbers.values():
        raise Refusal("RangeError", f"there are {', '.join(f'{name} ({each})' for name, each in numbers.items())}")
    return value
