"""A case performed, judged and shrunk."""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.torture.case import Case, draw, smaller, steps_of
from tests.torture.evidence import Evidence, RealEvidence
from tests.torture.invariants import Violation, violations
from tests.torture.lives import Life, live
from tests.torture.real import draw_real, live_real


@dataclass(frozen=True, slots=True)
class Result:
    """What came of a case. simulated_s: over all lives. events, rules of the guard: how often each was recorded.
    journal: its entries. steps: the kind of each step by its id."""

    case: Case
    lives: tuple[Life, ...]
    violations: tuple[Violation, ...]
    simulated_s: float
    events: Counter[str]
    rules: Counter[str]
    journal: list[dict[str, Any]]
    steps: dict[str, str]

    @property
    def broken(self) -> set[str]:
        """The invariants that were."""
        return {each.rule for each in self.violations}


def perform(case: Case, folder: Path | None = None, *, twice: bool = False) -> Result:
    """Run a case and look at it; without a folder nothing is left of it. twice: one without kills must leave the same
    bytes again."""
    place = folder or Path(tempfile.mkdtemp(prefix="torture-"))
    try:
        begun, lives = live_real(case, place) if case.is_real else (case, live(case, place))
        left = compute_digests(place)  # before the evidence, for which what is unfinished is salvaged
        evidence = (RealEvidence if case.is_real else Evidence)(begun, place, lives)
        spans_ns = [int(each["time_ns"][-1] - each["time_ns"][0]) for each in evidence.truth if len(each)]
        events = Counter(event.kind for event in evidence.events)
        trips = [event for event in evidence.events if event.kind.startswith("guard.") and "rule" in event.data]
        rules = Counter(str(event.data["rule"]) for event in trips)
        steps = {mark.step_id: mark.kind for mark in evidence.marks}
        found = tuple(violations(evidence))
        if twice and not case.kills_s and all(life.status is not None for life in evidence.lives):
            found += tuple(_find_differences(case, place, left))
        return Result(case, tuple(evidence.lives), found, sum(spans_ns) / 1e9, events, rules, evidence.journal, steps)
    finally:
        if folder is None:
            shutil.rmtree(place, ignore_errors=True)


def _find_differences(case: Case, folder: Path, first: dict[str, str]) -> Iterator[Violation]:
    live(case, folder)
    second = compute_digests(folder)
    differing = sorted(name for name in first.keys() | second.keys() if first.get(name) != second.get(name))
    if differing:
        yield Violation("is_the_same_twice", f"not the same twice: {', '.join(differing[:6])}", len(differing))


def compute_digests(folder: Path) -> dict[str, str]:
    """Of the session's files."""
    files = [path for path in folder.glob("out/*/**/*") if path.is_file()]
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def perform_seed(seed: int, *, is_real: bool = False) -> Result:
    """The case of a seed; in virtual time each eighth twice."""
    return perform(draw_real(seed)) if is_real else perform(draw(seed), twice=seed % 8 == 0)


def shrink(case: Case, rules: set[str], tries: int) -> Case:
    """The smallest found that still breaks one of the rules; each try is a run. What did not break it is tried again
    only when everything else was tried: most of what a case needs it goes on to need."""
    needed, again = set[str](), False
    while tries:
        for what, other in smaller(case):
            if what in needed or other == case:
                continue
            tries -= 1
            if perform(other).broken & rules:
                case, again = other, True
            else:
                needed.add(what)
            break
        else:
            if not again:
                break
            needed, again = set[str](), False
    return case


def format_result(result: Result) -> Iterator[str]:
    """A line for a case, and one for each violation."""
    case, hours = result.case, result.simulated_s / 3600.0
    ends = " ".join("hung" if life.status is None else str(life.status) for life in result.lives)
    counts = (
        f"{steps_of(case.plan)} steps, {len(case.faults)} faults, {len(case.orders)} orders, {len(case.kills_s)} kills"
    )
    yield f"{'BROKEN' if result.violations else 'ok    '} {case.seed}: {counts}; {hours:.2f} h; ended {ends}"
    for each in result.violations:
        yield f"    {each.rule} ({each.count}): {each.text}"
