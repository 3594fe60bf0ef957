"""What was found of a device: a verdict, the sentence, and what to do about it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

Verdict = Literal["ok", "unverified", "warning", "failed"]
_RISING: tuple[Verdict, ...] = ("ok", "unverified", "warning", "failed")


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at. device: its configured name, or bus, disk, clock. what: link, identity, settings,
    reading, a register point, or a move. unverified: it could not be decided from here, `advice` says how a person
    does. data: JSON-able figures, units in their names."""

    device: str
    what: str
    verdict: Verdict
    text: str
    advice: str = ""
    data: Mapping[str, object] = field(default_factory=dict[str, object])


Add = Callable[[Finding], None]


def worst(findings: Iterable[Finding]) -> Verdict:
    """ok when there is none."""
    found = {finding.verdict for finding in findings}
    for verdict in reversed(_RISING):
        if verdict in found:
            return verdict
    return "ok"
