"""A stand's file of an older form in the present one: the same content, with its comments, as text."""

from __future__ import annotations

import re
import textwrap
from dataclasses import dataclass
from typing import cast

import yaml

from foundation.documents import parse_document, yaml_data
from stand.config.older_forms import CAMERA, is_older, renewed, renewed_path
from stand.config.stand_config import StandConfig

_INDENT = "  "


@dataclass(frozen=True, slots=True)
class Migrated:
    """The text in today's form; where in the older file comments were that it has not."""

    text: str
    without_comments_of: tuple[str, ...]


def migrated(text: str, where: str) -> Migrated | None:
    """The file's text in today's form, None when it has it already. ConfigError, which begins with `where`, when it is
    no stand's file that could be opened."""
    before = parse_document(text, StandConfig, where)
    data = cast("dict[str, object]", yaml_data(text, where))
    if not is_older(data):
        return None
    wanted = renewed(data)
    sections = _sections(text)
    lost: list[str] = []
    for name, section in sections.items():
        if name == CAMERA:
            sections[name] = _below("cameras", section)
        elif name == "thermometers":
            sections[name] = _split(section) or _dumped(wanted, lost, "thermometer_module", name)
        elif name == "guard":
            sections[name] = re.sub(r"\bthermometers\.channels\.\w+", lambda path: renewed_path(path[0]), section)
    new = "".join(sections.values())
    if _read(new) != wanted:  # such as a file that is one flow mapping
        lost = ["the whole file"]
        new = _dumped(wanted, [], *wanted)
    if parse_document(new, StandConfig, where) != before:
        raise ValueError(f"{where}: means something else after the migration")
    return Migrated(new, tuple(lost))


def _sections(text: str) -> dict[str, str]:
    """The lines of each key at the top, with the comments in and behind it; those before the first under ""."""
    sections: dict[str, str] = {"": ""}
    name = ""
    for line in text.splitlines(keepends=True):
        if found := re.match(r"(\w+)\s*:", line):
            name = found[1]
        sections[name] = sections.get(name, "") + line
    return sections


def _below(name: str, section: str) -> str:
    """The section as the only entry of a new one; comments at the left edge stay there."""
    first, *others = section.splitlines(keepends=True)
    return f"{name}:\n{_INDENT}{first}" + "".join(
        _INDENT + line if line[0] in " \t" and line.strip() else line for line in others
    )


def _split(section: str) -> str:
    """Older `thermometers` as module and thermometers; "" when its entries do not stand on lines of their own."""
    first, *others = section.splitlines(keepends=True)
    behind: list[str] = []  # what belongs to the next section
    while others and (not others[-1].strip() or others[-1].startswith("#")):
        behind.insert(0, others.pop())
    found = [(at, entry) for at, line in enumerate(others) if (entry := re.match(r"( +)channels\s*:(.*\n)", line))]
    if len(found) != 1:
        return ""
    at, entry = found[0]
    if entry[2].strip() and not entry[2].strip().startswith("#"):
        return ""
    indent = len(entry[1])
    end = next(
        (
            number
            for number, line in enumerate(others[at + 1 :], at + 1)
            if line.strip() and len(line) - len(line.lstrip()) <= indent
        ),
        len(others),
    )
    channels = textwrap.dedent("".join(others[at + 1 : end]))
    module = first.replace("thermometers", "thermometer_module", 1) + "".join([*others[:at], *others[end:]])
    thermometers = f"thermometers:{entry[2]}{textwrap.indent(channels, _INDENT)}"
    return f"{module.rstrip()}\n\n{thermometers}{''.join(behind)}"


def _dumped(data: dict[str, object], lost: list[str], *names: str) -> str:
    """These entries without comments; the last one's name is noted in `lost`."""
    lost.extend(names[-1:])
    return yaml.safe_dump({name: data[name] for name in names}, sort_keys=False, allow_unicode=True)


def _read(text: str) -> object:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        return None
