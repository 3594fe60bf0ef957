"""`stand session list` of a thousand sessions, a process each time, against one that only sums up their files."""

from __future__ import annotations

import asyncio
import resource
import shutil
from pathlib import Path

from tests.bench.figures import (
    Figure,
    Measurement,
    compare,
    make_absolute,
    measure_in_turns,
    measure_process_ms,
    set_upper_goal,
)
from tests.recording.runs import record_run

SESSIONS = 1000
ROUNDS = 5
MOST_MS = 300.0
PEER = "stand session list of an empty folder"


def copy_sessions(folder: Path, count: int = SESSIONS) -> Path:
    """That many copies of a small session of 11 segments."""
    folder.mkdir(parents=True)
    asyncio.run(record_run(folder / "0000"))
    for number in range(1, count):
        shutil.copytree(folder / "0000", folder / f"{number:04d}")
    return folder


def make_listing_measurement(folder: Path) -> Measurement:
    """ms of the command."""
    return lambda: measure_process_ms("-m", "thermostand.stand.cli", "session", "list", folder)


def figures(folder: Path) -> list[Figure]:
    """The first list makes the index; then what it takes beside a list of nothing."""
    many = copy_sessions(folder / "listing")
    empty = folder / "no-sessions"
    empty.mkdir()
    first = make_absolute(f"first list of {SESSIONS} sessions", "ms", [make_listing_measurement(many)()])
    began_s = _children_s()
    ours, others = measure_in_turns(make_listing_measurement(many), make_listing_measurement(empty), ROUNDS)
    used_s = (_children_s() - began_s) / (ROUNDS + 1)
    peer = f"{PEER}; processor time of both {1e3 * used_s:.0f} ms, of what they took {sum(ours + others) / ROUNDS:.0f}"
    return [first, set_upper_goal(MOST_MS, compare(f"list of {SESSIONS} sessions", "ms", peer, ours, others))]


def _children_s() -> float:
    """Processor time of all processes that have ended."""
    found = resource.getrusage(resource.RUSAGE_CHILDREN)
    return found.ru_utime + found.ru_stime
