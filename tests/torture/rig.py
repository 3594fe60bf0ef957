"""A case performed, judged and shrunk."""

from __future__ import annotations

import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.torture.case import Case, draw, smaller, steps_of
from tests.torture.evidence import Evidence
from tests.torture.invariants import Violation, violations
from tests.torture.lives import Life, live


@dataclass(frozen=True, slots=True)
class Result:
    """What came of a case. simulated_s: over all lives. events, rules of the guard: how often each was recorded."""

    case: Case
    lives: tuple[Life, ...]
    violations: tuple[Violation, ...]
    simulated_s: float
    events: Counter[str]
    rules: Counter[str]

    @property
    def broken(self) -> set[str]:
        """The invariants that were."""
        return {each.rule for each in self.violations}


def perform(case: Case, folder: Path | None = None) -> Result:
    """Run a case and look at it; without a folder nothing is left of it."""
    place = folder or Path(tempfile.mkdtemp(prefix="torture-"))
    try:
        evidence = Evidence(case, place, live(case, place))
        spans_ns = [int(each["time_ns"][-1] - each["time_ns"][0]) for each in evidence.truth if len(each)]
        events = Counter(said.kind for said in evidence.said)
        trips = [said for said in evidence.said if said.kind.startswith("guard.") and "rule" in said.data]
        rules = Counter(str(said.data["rule"]) for said in trips)
        found = tuple(violations(evidence))
        return Result(case, tuple(evidence.lives), found, sum(spans_ns) / 1e9, events, rules)
    finally:
        if folder is None:
            shutil.rmtree(place, ignore_errors=True)


def perform_seed(seed: int) -> Result:
    """The case of a seed."""
    return perform(draw(seed))


def shrunk(case: Case, rules: set[str], tries: int) -> Case:
    """The smallest found that still breaks one of the rules; each try is a run."""
    untried = smaller(case)
    for _ in range(tries):
        if (other := next(untried, None)) is None:
            break
        if perform(other).broken & rules:
            case, untried = other, smaller(other)
    return case


def told(result: Result) -> Iterator[str]:
    """A line for a case, and one for each violation."""
    case, hours = result.case, result.simulated_s / 3600.0
    ends = " ".join("hung" if life.status is None else str(life.status) for life in result.lives)
    counts = (
        f"{steps_of(case.plan)} steps, {len(case.faults)} faults, {len(case.orders)} orders, {len(case.kills_s)} kills"
    )
    yield f"{'BROKEN' if result.violations else 'ok    '} {case.seed}: {counts}; {hours:.2f} h; ended {ends}"
    for each in result.violations:
        yield f"    {each.rule} ({each.count}): {each.text}"
