"""YAML file -> validated, frozen pydantic model, or a ConfigError of one line that names file and path."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable
from pathlib import Path
from typing import TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

from foundation.errors import ConfigError

_LONGEST_VALUE = 200  # characters of a faulty value that a message shows
_MOST_FAULTS = 20  # that a message names
# What pydantic says in terms of Python, in those of YAML.
OUR_WORDS = {
    "extra_forbidden": "unknown key; correct its name, or take it out",
    "missing": "is missing; give it",
    "too_short": "is empty or too short; give more entries",
    "tuple_type": "give a list: each entry behind a dash, or all in [ ]",
    "dict_type": "give keys and values, as in `key: value`",
    "model_type": "give keys and values, as in `key: value`",
}
_LONGEST_TEXT, _MOST_VALUES = 250_000, 100_000  # of a document: a hundred times of what ours have


class Document(BaseModel):
    """Base of every configuration model: unknown keys are errors, values do not change after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class _Loader(yaml.SafeLoader):
    """YAML keeps the last of two equal keys without a word; here that is an error, because one of them was meant."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, object]:
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        twice = next((key for key, count in Counter(keys).items() if count > 1), None)
        if twice is not None:
            raise yaml.constructor.ConstructorError(None, None, f"key {twice!r} is given twice", node.start_mark)
        return super().construct_mapping(node, deep)


Model = TypeVar("Model", bound=BaseModel)


def load_document(path: Path, model: type[Model]) -> Model:
    """The file as `model`; raises ConfigError that names file and path of every fault."""
    return parse_document(read_document(path), model, str(path))


def read_document(path: Path) -> str:
    """The file's text; ConfigError when it cannot be read, or is not UTF-8."""
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from error


def parse_document(text: str, model: type[Model], where: str) -> Model:
    """YAML text as `model`; `where` (a file name) begins every message of the ConfigError it may raise."""
    data = yaml_data(text, where)
    if not isinstance(data, dict):
        raise ConfigError(f"{where}: expected keys and values at the top, found {type(data).__name__}")
    try:
        return model.model_validate(data)
    except ValidationError as error:
        causes = _causes(error.errors())
        more = f"; and {len(causes) - _MOST_FAULTS} more" if len(causes) > _MOST_FAULTS else ""
        raise ConfigError("; ".join(_sentence(where, fault) for fault in causes[:_MOST_FAULTS]) + more) from error


def yaml_data(text: str, where: str) -> object:
    """What YAML text holds; ConfigError, which begins with `where`, when it is no YAML or far more than a document of
    ours: a few lines of aliases stand for millions of values."""
    if len(text) > _LONGEST_TEXT:
        raise ConfigError(f"{where}: has {len(text)} characters; a file of this kind has at most {_LONGEST_TEXT}")
    try:
        loader = _Loader(text)  # a SafeLoader
        node = loader.get_single_node()
        if node is None:
            return None
        if _size(node, {}) > _MOST_VALUES:
            raise ConfigError(f"{where}: aliases stand for more than {_MOST_VALUES} values; write out what is meant")
        return loader.construct_document(node)
    except RecursionError:
        raise ConfigError(f"{where}: not YAML that can be read (nested too deeply)") from None
    except (yaml.YAMLError, ValueError) as error:  # ValueError: a number or a date that Python cannot represent
        raise ConfigError(f"{where}: not YAML ({' '.join(str(error).split())})") from error
    except (LookupError, AttributeError) as error:  # what PyYAML lets out at a tag such as !!bool x
        raise ConfigError(f"{where}: not YAML (a value does not fit its tag)") from error


def _size(node: yaml.Node, known: dict[int, int]) -> int:
    """How many values a node stands for, each alias for as many as what it names; RecursionError when it is within
    itself. `known`: of the nodes seen so far."""
    if not isinstance(node, yaml.CollectionNode):
        return 1
    if id(node) not in known:
        known[id(node)] = _MOST_VALUES  # within itself
        parts = node.value if isinstance(node, yaml.SequenceNode) else [part for pair in node.value for part in pair]
        known[id(node)] = 1 + sum(_size(part, known) for part in parts)
    return known[id(node)]


def _causes(faults: list[ErrorDetails]) -> list[ErrorDetails]:
    """Without the faults that only follow from another one: a list is too short when its only entry is wrong."""
    places = [fault["loc"] for fault in faults]
    return [
        fault
        for fault in faults
        if fault["type"] != "too_short"
        or not any(place[: len(fault["loc"])] == fault["loc"] and place != fault["loc"] for place in places)
    ]


def _sentence(where: str, details: ErrorDetails) -> str:
    """One pydantic fault as `file: path: what is wrong (got value)`."""
    path = ".".join(str(part) for part in details["loc"])
    text = details["msg"].removeprefix("Value error, ")
    if not path:  # about the whole: the sentence names what it is about
        return f"{where}: {text}"
    value = details["input"]
    shown = "" if isinstance(value, dict | list) or value is None else f" (got {_shown(value)})"
    if (ours := OUR_WORDS.get(details["type"])) is not None:
        text = ours
        shown = "" if details["type"] == "extra_forbidden" else shown
    return f"{where}: {path}: {text}{shown}"


def _shown(value: object) -> str:
    """The value as it was given, shortened to what a reader needs to find it."""
    try:
        text = repr(value)
    except ValueError:  # an integer of more digits than Python prints
        return "a huge integer"
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]}..."
