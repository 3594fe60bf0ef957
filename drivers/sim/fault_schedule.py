"""Faults in advance: what breaks when, and for how long, in one line of text each.

    NAME[=VALUE][@TIME][:DURATION]        bus.drop=0.1@20min:60     flap.jam     thermometer.offset_K={"air": 3}@2h

TIME counts from the laboratory's start, DURATION from then on; both in s unless they end in s, min or h. Without TIME
it breaks at once, without DURATION it stays broken, without VALUE it breaks as badly as the table says.
"""

from __future__ import annotations

import heapq
import itertools
import json
import re
import threading
from collections.abc import Iterable
from dataclasses import dataclass
from difflib import get_close_matches

from thermostand.drivers.sim.laboratory import Laboratory
from thermostand.drivers.sim.laboratory_fault import Once
from thermostand.drivers.sim.laboratory_faults import FAULTS, inject
from thermostand.foundation.clock import seconds_ns
from thermostand.foundation.errors import ConfigError

_TIME = r"(\d+(?:\.\d+)?)(s|min|h)?"
_FORM = re.compile(rf"([A-Za-z_]+\.[A-Za-z_]+)(?:=(.+?))?(?:@{_TIME})?(?::{_TIME})?")
_SECONDS = {None: 1.0, "s": 1.0, "min": 60.0, "h": 3600.0}


@dataclass(frozen=True, slots=True)
class PlannedFault:
    """`name` has `value` from at_s after the start on, for for_s; None for good."""

    name: str
    value: object
    at_s: float = 0.0
    for_s: float | None = None


def parse_fault(text: str) -> PlannedFault:
    """One line of text; ConfigError when it is none, or names no fault."""
    found = _FORM.fullmatch(text.strip())
    if found is None:
        raise ConfigError(f"fault {text!r}: expected NAME[=VALUE][@TIME][:DURATION], such as bus.drop=0.1@20min:60")
    name, value, at, at_unit, length, length_unit = found.groups()
    if name not in FAULTS:
        near = get_close_matches(name, FAULTS, n=3, cutoff=0.4)
        hint = f"did you mean {', '.join(near)}?" if near else "`stand simulate --faults` lists them"
        raise ConfigError(f"fault {text!r}: there is no {name}; {hint}")
    at_s = float(at) * _SECONDS[at_unit] if at else 0.0
    for_s = float(length) * _SECONDS[length_unit] if length else None
    return PlannedFault(name, FAULTS[name].worst if value is None else _value(value), at_s, for_s)


def _value(text: str) -> object:
    """A number, true, false or an object as JSON, else the text itself."""
    try:
        value: object = json.loads(text)
    except ValueError:
        return text
    return value


class FaultSchedule:
    """Breaks and mends a laboratory, as planned or by hand. `advance` leads virtual time, `tick` follows real time."""

    def __init__(self, laboratory: Laboratory, faults: Iterable[PlannedFault]) -> None:
        """Breaks what is due at the start; ConfigError when this laboratory cannot have what is planned, then or later:
        each is tried and mended again, but for what happens in an instant and leaves its traces."""
        self._laboratory = laboratory
        self._lock = threading.Lock()
        self._due: list[tuple[int, int, str, object]] = []
        self._number = itertools.count()
        self._ends: dict[str, int] = {}  # the number of the end of what was broken by hand
        self._standing: dict[str, object] = {}
        start_ns = laboratory.now_ns
        for planned in faults:
            if planned.at_s > 0 and not isinstance(FAULTS[planned.name].apply, Once):
                self._set(planned.name, planned.value)
                self._set(planned.name, FAULTS[planned.name].mended)
            at_ns = start_ns + seconds_ns(planned.at_s)
            self._push(at_ns, planned.name, planned.value)
            if planned.for_s is not None:
                self._push(at_ns + seconds_ns(planned.for_s), planned.name, FAULTS[planned.name].mended)
        self._break_until(start_ns)

    def standing(self) -> dict[str, object]:
        """What is broken now, with its value; what just happens (a restart) is not."""
        with self._lock:
            return dict(self._standing)

    def break_now(self, name: str, value: object, for_s: float | None) -> None:
        """By hand; None: until it is mended. ConfigError when there is no such fault, or this laboratory cannot have
        it. The end of one that was broken by hand before is forgotten."""
        if name not in FAULTS:
            raise ConfigError(f"there is no fault {name}")
        with self._lock:
            self._set(name, value)
            self._forget_end(name)
            if for_s is not None:
                self._ends[name] = self._push(self._laboratory.now_ns + seconds_ns(for_s), name, FAULTS[name].mended)

    def mend(self, name: str) -> None:
        """By hand; ConfigError as in `break_now`."""
        if name not in FAULTS:
            raise ConfigError(f"there is no fault {name}")
        with self._lock:
            self._set(name, FAULTS[name].mended)
            self._forget_end(name)

    def advance(self, now_ns: int) -> None:
        """Virtual time moves to `now_ns`, with every change at its own instant; ValueError in real time, ConfigError as
        in `tick`."""
        with self._lock:
            while self._due and self._due[0][0] <= now_ns:
                self._laboratory.advance(max(self._due[0][0], self._laboratory.now_ns))
                self._change()
            self._laboratory.advance(now_ns)

    def tick(self) -> None:
        """In real time: what has become due; ConfigError when this laboratory cannot have it."""
        if not self._laboratory.is_virtual:
            with self._lock:
                self._break_until(self._laboratory.now_ns)

    def _break_until(self, now_ns: int) -> None:
        while self._due and self._due[0][0] <= now_ns:
            self._change()

    def _push(self, at_ns: int, name: str, value: object) -> int:
        number = next(self._number)
        heapq.heappush(self._due, (at_ns, number, name, value))
        return number

    def _forget_end(self, name: str) -> None:
        if (number := self._ends.pop(name, None)) is not None:
            self._due = [due for due in self._due if due[1] != number]
            heapq.heapify(self._due)

    def _change(self) -> None:
        _, _, name, value = heapq.heappop(self._due)
        self._set(name, value)

    def _set(self, name: str, value: object) -> None:
        try:
            inject(self._laboratory, name, value)
        except (ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"fault {name}={json.dumps(value)}: this laboratory cannot have it ({error})") from error
        if value == FAULTS[name].mended or isinstance(FAULTS[name].apply, Once):
            self._standing.pop(name, None)
        else:
            self._standing[name] = value
