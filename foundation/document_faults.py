"""What is wrong with a document, in terms of its YAML: the line, the key, the value as it was written, what to type."""

from __future__ import annotations

import difflib
import re
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import zip_longest
from typing import Annotated, Any, Union, cast, get_args, get_origin

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

Place = Sequence[int | str]  # keys and numbers of entries, from the top

_LONGEST_VALUE = 200  # characters of a faulty value that a message shows
_MOST_FAULTS = 20  # that a message names
_ADVICE: Mapping[str, str] = {  # by what PyYAML says
    "found character '\\t'": "; indent with spaces, not with tabs",
    "mapping values are not allowed": "; text with a colon and a space in it needs quotes, and keys of one section "
    "begin in one column",
    "could not find expected ':'": "; a key has a colon and a space behind it",
    "expected <block end>": "; keys of one section begin in one column",
    "unexpected end of stream": "; a quotation mark is not closed",
    "expected ',' or": "; a bracket is not closed, or a comma is missing",
}
_KEY = "[key]"
_NUMBERS = ("float_type", "float_parsing", "int_type", "int_parsing")
_WORDS: Mapping[str, str] = {
    "missing": "is missing; give it",
    "too_short": "is empty or too short; give more entries",
    "tuple_type": "give a list: each entry behind a dash, or all in [ ]",
    "list_type": "give a list: each entry behind a dash, or all in [ ]",
    "dict_type": "give keys and values, as in `key: value`",
    "model_type": "give keys and values, as in `key: value`",
    "bool_type": "give true or false",
    "bool_parsing": "give true or false",
    "int_from_float": "give a whole number",
    "invalid_key": "is no name of a key; decimals stand behind a point, as in 0.5 and not 0,5",
    "path_type": "give a path, in quotes where it looks like a number",
    "date_from_datetime_parsing": "give a date as 2026-03-31",
    "date_parsing": "give a date as 2026-03-31",
    "date_type": "give a date as 2026-03-31",
    "timezone_aware": "needs its time zone; end it with Z, as in 2026-01-01T18:00:00Z",
}
_PATTERNS: Mapping[str, str] = {
    r"^[a-z][a-z0-9_]{0,30}$": "begins with a lower-case letter, then lower-case letters, digits and _, at most 31",
    r"^[a-z0-9][a-z0-9-]*$": "consists of lower-case letters, digits and dashes",
    r"^[^\x00-\x1f\x7f-\x9f]*$": "must be one line of characters that can be shown",
}
_UNITS: Mapping[str, Mapping[str, float]] = {  # by the end of a key: what may be written for it, and how large that is
    "s": {"s": 1, "sec": 1, "ms": 1e-3, "us": 1e-6, "min": 60, "h": 3600, "d": 86400},
    "h": {"h": 1, "min": 1 / 60, "s": 1 / 3600, "d": 24},
    "mm": {"mm": 1, "cm": 10, "m": 1000, "um": 1e-3},
    "deg": {"deg": 1, "°": 1},
    "degC": {"degC": 1, "°C": 1, "C": 1},
    "K": {"K": 1},
    "W": {"W": 1, "kW": 1000},
    "GB": {"GB": 1, "MB": 1e-3, "TB": 1000},
    "percent": {"%": 1, "percent": 1},
}
_WITH_UNIT = re.compile(r"\s*([-+]?\d*[.,]?\d+(?:e[-+]?\d+)?)\s*([a-zA-Z°%]*)\s*")


TAG = "<"  # begins the tags of our unions, which are no keys
_TAGS = (TAG, "literal[")  # of what an older form lacks; and pydantic's of a choice of words


class _YamlDocument:
    """A document as its YAML has it. A mapping's keys are listed once, however many of them are looked up."""

    def __init__(self, root: yaml.Node | None) -> None:
        self._root = root
        self._keys: dict[int, dict[str, tuple[yaml.Node, yaml.Node]]] = {}  # by id of the mapping: key, value

    def found(self, place: Place) -> tuple[int | None, yaml.Node | None]:
        """The line, from 1, of the key or entry at this place, or of what it is in when it is not there itself; and
        its value, None when it is not there."""
        line, node = None, self._root
        for part in place:
            key, node = self._find_entry(node, part)
            if key is None:
                break
            line = key.start_mark.line + 1
        return line, node

    def strip_union_tags(self, fault: ErrorDetails) -> tuple[int | str, ...]:
        """The fault's place, without the tags of unions, which pydantic puts between a key and those below it."""
        kept, node = list[int | str](), self._root
        for number, part in enumerate(fault["loc"]):
            key, inner = self._find_entry(node, part)
            is_last = number == len(fault["loc"]) - 1
            is_between = isinstance(node, yaml.MappingNode) if not is_last else fault["type"] == "model_type"
            if number and node is not None and key is None and is_between:
                continue
            if isinstance(part, str) and part.startswith(_TAGS) and key is None:
                continue
            kept.append(part)
            node = inner
        return tuple(kept)

    def _find_entry(self, node: yaml.Node | None, part: int | str) -> tuple[yaml.Node | None, yaml.Node | None]:
        """The key (of a list: the entry) of this name or number, and its value."""
        if isinstance(node, yaml.MappingNode):
            return self._index_keys(node).get(str(part), (None, None))
        if isinstance(node, yaml.SequenceNode) and isinstance(part, int) and part < len(node.value):
            return node.value[part], node.value[part]
        return None, None

    def _index_keys(self, node: yaml.MappingNode) -> dict[str, tuple[yaml.Node, yaml.Node]]:
        if id(node) not in self._keys:
            pairs = [(key, value) for key, value in node.value if isinstance(key, yaml.ScalarNode)]
            self._keys[id(node)] = {key.value: (key, value) for key, value in pairs}
        return self._keys[id(node)]


def describe_faults(where: str, error: ValidationError, model: type[BaseModel], root: yaml.Node | None) -> str:
    """All faults of a document of this model, in one line; `root`: the YAML they are in."""
    yaml_text = _YamlDocument(root)
    faults = _keep_causes([{**fault, "loc": yaml_text.strip_union_tags(fault)} for fault in error.errors()])
    more = f"; and {len(faults) - _MOST_FAULTS} more" if len(faults) > _MOST_FAULTS else ""
    listed: set[tuple[int | str, ...]] = set()  # places whose keys were listed
    details: list[str] = []
    for fault in faults[:_MOST_FAULTS]:
        advice = ""
        if fault["type"] == "extra_forbidden":
            advice = _suggest_key(fault["loc"], model, listed)
            listed.add(fault["loc"][:-1])
        details.append(_format_fault(where, fault, yaml_text, advice))
    return "; ".join(details) + more


def describe_yaml_error(error: yaml.YAMLError | ValueError) -> str:
    """Return why a text is no YAML, where, and what to look for."""
    if isinstance(error, yaml.MarkedYAMLError):
        mark = error.problem_mark or error.context_mark
        problem = " ".join((error.problem or error.context or "").split())
        at = f" (line {mark.line + 1}, column {mark.column + 1})" if mark is not None else ""
        advice = next((text for words, text in _ADVICE.items() if words in problem), "")
        return f"{problem}{at}{advice}"
    if isinstance(error, yaml.reader.ReaderError):
        return f"the character number {error.position + 1} must not be in a text"
    return " ".join(str(error).split())


def describe_fault(fault: ErrorDetails, written: str | None = None) -> str:
    """Return what is wrong with a value, and what to type; written: the value as it stands in the file, where that is
    known."""
    kind, place = fault["type"], fault["loc"]
    if kind == "extra_forbidden":
        return "unknown key; correct its name, or take it out"
    if kind in _NUMBERS:
        return _suggest_number(place, fault["input"], whole=kind.startswith("int"))
    if kind == "string_type":
        is_plain = written and not isinstance(fault["input"], dict | list)
        return f"give text, in quotes: '{written[:_LONGEST_VALUE]}'" if written and is_plain else "give text"
    if (ours := _WORDS.get(kind)) is not None:
        return ours
    if kind == "string_pattern_mismatch" and (text := _PATTERNS.get(fault.get("ctx", {}).get("pattern", ""), "")):
        return text
    message = fault["msg"].removeprefix("Value error, ")
    text = re.sub(r"^(Input|String|Value|Tuple|List|Dictionary) should ", "must ", message)
    if kind == "literal_error" and isinstance(fault["input"], str):
        text += nearest(fault["input"], re.findall(r"'([^']*)'", text))
    return text


def describe_booleans_for_numbers(where: str, data: object, model: type[BaseModel], root: yaml.Node | None) -> str:
    """The sentence about `yes`, `no`, `on` or `off` where a number belongs, which would be 1 or 0; "" without such."""
    yaml_text = _YamlDocument(root)
    for place in _find_booleans(data, ()):
        types_ = {each for each in _find_types(model, place) if isinstance(each, type)}
        if types_ and types_ <= {int, float, types.NoneType}:
            _, node = yaml_text.found(place)
            written = node.value if isinstance(node, yaml.ScalarNode) else ""
            kind = "float_type" if float in types_ else "int_type"
            return _format_fault(where, ErrorDetails(type=kind, loc=place, msg="", input=written), yaml_text, "")
    return ""


def _find_booleans(data: object, place: tuple[int | str, ...]) -> Iterator[tuple[int | str, ...]]:
    """The places of all true and false."""
    if isinstance(data, bool):
        yield place
    elif isinstance(data, dict):
        for key, value in cast("dict[object, object]", data).items():
            yield from _find_booleans(value, (*place, str(key)))
    elif isinstance(data, list):
        for number, value in enumerate(cast("list[object]", data)):
            yield from _find_booleans(value, (*place, number))


def _keep_causes(faults: list[ErrorDetails]) -> list[ErrorDetails]:
    """Leave out the faults that only follow from another one: a list is too short when its only entry is wrong, and who
    has mistyped one of a choice of words did not mean keys and values."""
    misspelt = {fault["loc"] for fault in faults if fault["type"] == "literal_error"}
    faults = [fault for fault in faults if fault["type"] != "model_type" or fault["loc"] not in misspelt]
    if not any(fault["type"] == "too_short" for fault in faults):
        return faults
    above = {fault["loc"][:length] for fault in faults for length in range(len(fault["loc"]))}
    return [fault for fault in faults if fault["type"] != "too_short" or fault["loc"] not in above]


def _format_fault(where: str, fault: ErrorDetails, yaml_text: _YamlDocument, advice: str) -> str:
    """One fault as `file: path: what is wrong (got value, line N)`."""
    place = fault["loc"]
    line, node = yaml_text.found(place)
    written = node.value if isinstance(node, yaml.ScalarNode) else None
    text = describe_fault(fault, written) + advice
    if not place:  # about the whole: the sentence names what it is about
        return f"{where}: {text}"
    value, details = fault["input"], list[str]()
    if isinstance(node, yaml.ScalarNode) and value is None and not node.value:
        details.append("nothing stands behind the key")
    elif not isinstance(value, dict | list) and value is not None and fault["type"] != "extra_forbidden":
        details.append(f"got {_shorten(value)}")
    if line is not None:
        details.append(f"line {line}")
    path = format_path((*place[:-1], str(place[-1])) if fault["type"] == "invalid_key" else place)
    return f"{where}: {path}: {text}" + (f" ({', '.join(details)})" if details else "")


def format_path(place: Iterable[int | str]) -> str:
    """A place as people read it: entries are counted from 1, as steps are everywhere. Of a key that is a number
    pydantic says so behind it."""
    parts = tuple(place)
    numbered = zip_longest(parts, parts[1:])
    return ".".join(
        str(part + 1 if isinstance(part, int) and behind != _KEY else part) for part, behind in numbered if part != _KEY
    )


def _suggest_number(place: Place, value: object, *, whole: bool) -> str:
    """Return what to type instead of this value."""
    key = next((part for part in reversed(place) if isinstance(part, str)), "")
    unit = next((end for end in _UNITS if key.endswith(f"_{end}")), "")
    text = f"give a {'whole ' if whole else ''}number" + (f" in {unit}, without the unit" if unit else "")
    match = _WITH_UNIT.fullmatch(value) if isinstance(value, str) else None
    if match is None:
        return text
    size = {"": 1.0, **_UNITS.get(unit, {})}.get(match[2])
    return text if size is None else f"{text}: {float(match[1].replace(',', '.')) * size:.12g}"


def _suggest_key(place: tuple[int | str, ...], model: type[BaseModel], listed: set[tuple[int | str, ...]]) -> str:
    """The key that may be meant, or those there are at this place unless they were listed before."""
    known = sorted({name for each in _find_models(model, place[:-1]) for name in each.model_fields})
    if near := nearest(str(place[-1]), known):
        return near
    return f"; known here: {', '.join(known)}" if known and place[:-1] not in listed else ""


def nearest(name: str, known: Iterable[str]) -> str:
    """`; did you mean NAME?` of the known name that is most like it, "" when none is."""
    near = difflib.get_close_matches(name, list(known), 1, 0.6)
    return f"; did you mean {near[0]}?" if near else ""


def _find_models(model: type[BaseModel], place: Place) -> list[type[BaseModel]]:
    """The models that what stands at this place may be."""
    return [each for each in _find_types(model, place) if isinstance(each, type) and issubclass(each, BaseModel)]


def _find_types(model: type[BaseModel], place: Place) -> list[Any]:
    """Return what may stand at this place; nothing where that is not known."""
    options: list[Any] = [model]
    for part in place:
        options = [inner for option in options for inner in _find_entry_types(option, part)]
    return [each for option in options for each in _flatten_union(option)]


def _find_entry_types(annotation: Any, part: int | str) -> Iterator[Any]:
    """The types of the entry `part` of values of this type."""
    for option in _flatten_union(annotation):
        if isinstance(option, type) and issubclass(option, BaseModel):
            field = option.model_fields.get(str(part))
            if field is not None:
                yield field.annotation
        elif get_origin(option) is dict:
            yield get_args(option)[1]
        elif get_origin(option) in (tuple, list):
            yield from (each for each in get_args(option) if each is not Ellipsis)


def _flatten_union(annotation: Any) -> list[Any]:
    """The types of a union, without what is annotated to them."""
    if get_origin(annotation) is Annotated:
        return _flatten_union(get_args(annotation)[0])
    if get_origin(annotation) in (Union, types.UnionType):
        return [each for option in get_args(annotation) for each in _flatten_union(option)]
    return [annotation]


def _shorten(value: object) -> str:
    """The value as it was given, shortened to what a reader needs to find it."""
    try:
        text = repr(value)
    except ValueError:  # an integer of more digits than Python prints
        return "a huge integer"
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]}..."
