"""The guard's rules of other packages: entry points of the group `thermostand.guard_rules`.

Each leads to a GuardRule, whose name is the entry's and its key below `guard.added` of a stand's file. The event, its
advice, what is alerted and the page of troubleshooting follow from that row, as for our own rules.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Any, cast

from pydantic import ValidationError
from pydantic_core import PydanticCustomError

from thermostand.foundation.document_faults import path_text, words
from thermostand.foundation.documents import Document
from thermostand.foundation.events import GUARD, KINDS, guard_rule
from thermostand.stand.fault import Watch

GROUP = "thermostand.guard_rules"


@dataclass(frozen=True, slots=True)
class GuardRule:
    """One kind of rule.

    says: what it objects to, in general. settings: its keys in a stand's file. watches: of these settings and the
    stand's whole configuration, what is looked at every guard.period_s; a fault of theirs has this name as its rule.
    advice: where it only warns.
    """

    name: str
    says: str
    settings: type[Document]
    watches: Callable[[Any, Any], Iterable[Watch]]
    advice: str = ""


def added_rule(name: str) -> GuardRule:
    """The rule of that name; ValueError when no package adds it, or it cannot be loaded."""
    for point in entry_points(group=GROUP, name=name):
        package = point.value if point.dist is None else f"{point.dist.name} {point.dist.version}"
        try:
            rule = point.load()
        except Exception as error:  # importing a stranger's module may raise anything
            raise ValueError(f"{name}: {package} cannot be loaded ({error}); reinstall it") from error
        if not isinstance(rule, GuardRule) or rule.name != name:
            raise ValueError(f"{name}: {package} has no GuardRule of that name there; correct the package")
        if GUARD + name not in KINDS:
            guard_rule(name, rule.says, rule.advice)
        return rule
    known = ", ".join(sorted({point.name for point in entry_points(group=GROUP)})) or "none installed"
    raise ValueError(f"no package adds a rule {name!r}; there are {known}")


def added_rules(data: object) -> object:
    """The settings of each, by its name; ValueError for what they do not take."""
    if not isinstance(data, Mapping):
        return data
    given = cast("Mapping[str, object]", data)
    try:
        return {name: added_rule(name).settings.model_validate(each or {}) for name, each in given.items()}
    except ValidationError as error:
        faults = (f"{path_text(each['loc'])}: {words(each)}" for each in error.errors())
        raise PydanticCustomError("guard_rule", "{text}", {"text": "; ".join(faults)}) from error
