"""YAML file -> validated, frozen pydantic model, or a ConfigError of one line that names file and path."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Hashable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from thermostand.foundation.document_faults import (
    describe_booleans_for_numbers,
    describe_faults,
    describe_yaml_error,
    format_path,
)
from thermostand.foundation.errors import ConfigError, NotFound, SessionError
from thermostand.foundation.files import describe_unreadable

if TYPE_CHECKING or not yaml.__with_libyaml__:
    from yaml import SafeLoader as QuickLoader
else:
    from yaml import CSafeLoader as QuickLoader

_LONGEST_TEXT, _MOST_VALUES = 250_000, 100_000  # of a document: a hundred times of what ours have
_LONGEST_JSON = 20_000_000  # bytes: the model of a session has 0.6 MB, one of the oldest format 5
_MAKE_AGAIN = "; it was changed or damaged since: take it from where it was made, or make it again"
_MOST_OPENED = 2000  # characters that may begin a level


class Document(BaseModel):
    """Base of every configuration model: unknown keys are errors, values do not change after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class _Strict(yaml.constructor.SafeConstructor):
    """YAML keeps the last of two equal keys without a word; here that is an error, because one of them was meant. So
    is a number that YAML 1.1 takes to another base: 0042 is 34 there, and 1:30 is 90."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, object]:
        seen = set[str]()
        for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode)):
            if key.value in seen:
                raise yaml.constructor.ConstructorError(None, None, f"key {key.value!r} is given twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        number, written = super().construct_yaml_int(node), node.value
        if _OCTAL.fullmatch(written) or ":" in written:
            base = "60" if ":" in written else "8"
            advice = f"{written} is {number} in YAML, a number to base {base}; put it in quotes, '{written}'"
            advice += "" if ":" in written else f", or write {written.lstrip('0')}"
            raise yaml.constructor.ConstructorError(None, None, advice, node.start_mark)
        return number


class _Loader(_Strict, yaml.SafeLoader):
    """The loader in Python: the one that says what is wrong with a text, and where."""


class _FastLoader(_Strict, QuickLoader):
    """The loader by libyaml, ten times as fast. It ends the process at ten thousands of levels, hence _MOST_OPENED."""


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)
_FastLoader.add_constructor("tag:yaml.org,2002:int", _FastLoader.construct_yaml_int)


_OCTAL = re.compile(r"[-+]?0[0-7_]+")
Model = TypeVar("Model", bound=BaseModel)
Read = TypeVar("Read")


def load_document(path: Path, model: type[Model]) -> Model:
    """The file as `model`; raises ConfigError that names file and path of every fault."""
    return parse_document(read_document(path), model, str(path))


def read_document(path: Path) -> str:
    """The file's text; ConfigError when it cannot be read, or is not UTF-8."""
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(describe_unreadable(path, error)) from error


def parse_document(text: str, model: type[Model], where: str) -> Model:
    """YAML text as `model`; `where` (a file name) begins every message of the ConfigError it may raise."""
    data, root = _load_yaml(text, where)
    if not isinstance(data, dict):
        found = "nothing" if data is None else "a list" if isinstance(data, list) else "a value alone"
        raise ConfigError(f"{where}: begins with keys and values, as in `name: my-stand`; there is {found}")
    if wrong := describe_booleans_for_numbers(where, data, model, root):
        raise ConfigError(wrong)
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise ConfigError(describe_faults(where, error, model, root)) from error


def load_json(path: Path | str, read: Callable[[str], Read], what: str) -> Read:
    """Return what `read` makes of the text of a JSON file that this program has written; SessionError, which says that
    it is not `what`, when that refuses it, the file cannot be read or is far longer than any of ours, a key is given
    twice, or values are nested deeper than Python goes."""
    try:
        with Path(path).open("rb") as file:  # at most so much, also of a device without an end
            data = file.read(_LONGEST_JSON + 1)
        text = data.decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        kind = NotFound if isinstance(error, FileNotFoundError) else SessionError
        raise kind(describe_unreadable(path, error)) from error
    not_ours = f"{path}: not {what} of this program"
    if len(data) > _LONGEST_JSON:
        raise SessionError(f"{not_ours} (it has more than {_LONGEST_JSON // 10**6} MB, and such a file has less)")
    try:
        json.loads(text, object_pairs_hook=_reject_repeated_keys)
        return read(text)
    except RecursionError:
        raise SessionError(f"{not_ours} (nested too deeply)") from None
    except ValidationError as error:
        fault = error.errors()[0]
        # What a file of another kind lacks is no news to a reader; what is wrong inside of one of this kind is.
        where, kind_of_fault = format_path(fault["loc"]), fault["type"]
        place = f"{where}: " if where else ""  # what concerns the whole file has none
        more = (
            "" if kind_of_fault.startswith("union_tag") else f" ({place}{fault['msg'].removeprefix('Value error, ')})"
        )
        raise SessionError(f"{not_ours}{more}{_MAKE_AGAIN}") from error
    except ValueError as error:
        raise SessionError(f"{not_ours} ({error}){_MAKE_AGAIN}") from error


def _reject_repeated_keys(pairs: list[tuple[str, object]]) -> dict[str, object]:
    """JSON parsers keep the last of two equal keys without a word."""
    found = dict(pairs)
    if len(found) < len(pairs):
        seen = set[str]()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))
        raise ValueError(f"key {twice!r} is given twice")
    return found


def parse_yaml(text: str, where: str) -> object:
    """Return what YAML text holds; ConfigError, which begins with `where`, when it is no YAML or far more than a
    document of ours: a few lines of aliases stand for millions of values."""
    return _load_yaml(text, where)[0]


def _load_yaml(text: str, where: str) -> tuple[object, yaml.Node | None]:
    """Return what YAML text holds, and as it is written."""
    if len(text) > _LONGEST_TEXT:
        raise ConfigError(f"{where}: has {len(text)} characters; a file of this kind has at most {_LONGEST_TEXT}")
    if sum(map(text.count, "[{-?")) <= _MOST_OPENED:
        with suppress(RecursionError, yaml.YAMLError, ValueError, LookupError, AttributeError):
            return _construct(_FastLoader(text), where)
    try:
        return _construct(_Loader(text), where)
    except RecursionError:
        raise ConfigError(f"{where}: not YAML that can be read (nested too deeply)") from None
    except (yaml.YAMLError, ValueError) as error:  # ValueError: a number or a date that Python cannot represent
        raise ConfigError(f"{where}: not YAML ({describe_yaml_error(error)})") from error
    except (LookupError, AttributeError) as error:  # what PyYAML lets out at a tag such as !!bool x
        raise ConfigError(f"{where}: not YAML (a value does not fit its tag)") from error


def _construct(loader: _Loader | _FastLoader, where: str) -> tuple[object, yaml.Node | None]:
    node = loader.get_single_node()
    if node is None:
        return None, None
    if _count_values(node, {}) > _MOST_VALUES:
        raise ConfigError(f"{where}: aliases stand for more than {_MOST_VALUES} values; write out what is meant")
    return loader.construct_document(node), node


def _count_values(node: yaml.Node, known: dict[int, int]) -> int:
    """Return how many values a node stands for, each alias for as many as what it names; RecursionError when it is
    within itself. `known`: of the nodes seen so far."""
    if not isinstance(node, yaml.CollectionNode):
        return 1
    if id(node) not in known:
        known[id(node)] = _MOST_VALUES  # within itself
        parts = node.value if isinstance(node, yaml.SequenceNode) else [part for pair in node.value for part in pair]
        known[id(node)] = 1 + sum(_count_values(part, known) for part in parts)
    return known[id(node)]
