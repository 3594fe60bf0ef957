"""The guard's rules of other packages: entry points of the group `thermostand.guard_rules`.

Each leads to a GuardRule, whose name is the entry's and its key below `guard.added` of a stand's file. The event, its
advice, what is alerted and the page of troubleshooting follow from that row, as for our own rules.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, cast

from thermostand.foundation.documents import Document
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.events import GUARD, KINDS, guard_rule
from thermostand.foundation.plugins import check_settings, load_row
from thermostand.stand.safety.fault import Watch

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


def load_rule(name: str) -> GuardRule:
    """The rule of that name; ConfigError when no package adds it, or it cannot be loaded."""
    rule = load_row(GROUP, name, GuardRule, "a rule")
    if GUARD + name not in KINDS:
        guard_rule(name, rule.says, rule.advice)
    return rule


def load_rule_settings(data: object) -> object:
    """The settings of each, by its name; ValueError for what they do not take."""
    if not isinstance(data, Mapping):
        return data
    given = cast("Mapping[str, Mapping[str, object] | None]", data)
    try:
        return {name: check_settings(load_rule(name).settings, each or {}) for name, each in given.items()}
    except ConfigError as error:
        raise ValueError(str(error)) from error
