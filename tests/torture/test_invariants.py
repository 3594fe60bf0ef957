"""Each invariant of the torture rig finds what it forbids, and nothing in a quiet case; drawing and shrinking."""

from __future__ import annotations

import copy
import itertools
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.system.conftest import require_aravis
from tests.torture.case import MOST_FAULTS, PLAIN, Case, Fault, Order, draw, read_case, steps_of, write_case
from tests.torture.evidence import Evidence, RecordedEvent
from tests.torture.invariants import INVARIANTS, RELAYS_UNIT, violations
from tests.torture.lives import live
from tests.torture.real import draw_real
from tests.torture.rig import shrink


def at(degC: float, role: str) -> list[Any]:
    return [
        {"set_temperature": degC},
        {"soak": 600},
        "open_flap",
        {"capture": {"frames": 2, "interval_s": 5, "role": role}},
        "close_flap",
    ]


QUIET = {
    "steps": [
        "close_flap",
        {"start_chamber": 26},
        *at(26, "reference"),
        *at(30, "fit"),
        *at(34, "fit"),
        *at(38, "fit"),
        {"set_temperature": 16},
        {"soak": 300},
        "stop_chamber",
    ]
}


@pytest.fixture(scope="module")
def quiet() -> Iterator[Evidence]:
    """Of a case in which nothing breaks."""
    require_aravis()
    case = Case(1, {**PLAIN, "axes": "no axes"}, QUIET)
    with tempfile.TemporaryDirectory() as folder:
        evidence = Evidence(case, Path(folder), live(case, Path(folder)))
        assert evidence.truth
        assert evidence.bus
        assert evidence.doors
        assert evidence.journal
        yield evidence


def changed(evidence: Evidence, name: str, value: float, first: float = 0.0, last: float = 1.0) -> None:
    """What the plant's column was in this part of its time."""
    for truth in evidence.truth:
        truth[name][round(first * len(truth)) : round(last * len(truth))] = value


def middle_ns(evidence: Evidence) -> int:
    return int(np.median(evidence.truth[0]["time_ns"]))


def no_more(evidence: Evidence, is_of_it: Callable[[int], bool]) -> None:
    """Nothing is reported to such units from the middle on."""
    middle = middle_ns(evidence)
    evidence.bus[0] = [each for each in evidence.bus[0] if each.time_ns < middle or not is_of_it(each.unit)]
    changed(evidence, "heater_enabled", 1.0, 0.4)


def hold(evidence: Evidence) -> None:
    begin = middle_ns(evidence)
    evidence.events.append(RecordedEvent(begin, "warning", "held", "", {"reason": "interlock"}))
    evidence.events.append(RecordedEvent(begin + int(200e9), "info", "released", "", {"reason": "interlock"}))
    changed(evidence, "heater_enabled", 1.0)


def end(evidence: Evidence, **how: Any) -> None:
    evidence.lives = [*evidence.lives[:-1], replace(evidence.lives[-1], **how)]


def stop_program(evidence: Evidence) -> None:
    body = {"for_s": 200.0}
    evidence.doors[0].append({"time_ns": middle_ns(evidence), "verb": "daemon_stopped", "body": body, "answer": None})
    changed(evidence, "heater_enabled", 1.0)


def press_stop(evidence: Evidence) -> None:
    body = {"way": "TCP", "took_s": 5.0, "late_s": 0.1}
    evidence.doors[0].append({"time_ns": middle_ns(evidence), "verb": "stop_pressed", "body": body, "answer": True})
    end(evidence, opened_ns=1, ended_ns=sys.maxsize)


def fail_thrice(evidence: Evidence) -> None:
    evidence.lives = [replace(evidence.lives[0], status=1, err=f"error: a cable is {n} m long\n") for n in range(3)]


def pester(evidence: Evidence) -> None:
    evidence.events += [RecordedEvent(number, "warning", "some", f"{number} K", {}) for number in range(8)]


def switch_compressor(evidence: Evidence) -> None:
    changed(evidence, "compressor_on", 0.0)
    changed(evidence, "compressor_on", 1.0, 0.2, 0.3)
    changed(evidence, "compressor_on", 1.0, 0.32, 0.4)


def misread(evidence: Evidence) -> None:
    evidence.temperatures["air"] = [(at, degC + 2.0, quality) for at, degC, quality in evidence.temperatures["air"]]


def blow_up(evidence: Evidence) -> None:
    """What the camera truly saw, the more the later."""
    for share, centres in enumerate(evidence.centres.values()):
        centres *= 1.0 + 0.001 * share


FORBIDDEN: dict[str, Callable[[Evidence], object]] = {
    "air_is_never_too_warm": lambda evidence: changed(evidence, "bulk_air_degC", 69.0, 0.5, 0.6),
    "heat_needs_a_permission_of_the_last_15_s": lambda evidence: no_more(evidence, lambda unit: unit == RELAYS_UNIT),
    "heat_needs_fresh_readings": lambda evidence: no_more(evidence, lambda unit: unit != RELAYS_UNIT),
    "nothing_heats_unrecorded": lambda evidence: evidence.events.clear(),
    "compressor_rests": switch_compressor,
    "flap_is_open_for_captures_only": lambda evidence: changed(evidence, "flap_open", 1.0),
    "holds_are_safe": hold,
    "ends_are_safe": lambda evidence: changed(evidence, "heater_enabled", 1.0, 0.9),
    "files_are_readable": lambda evidence: evidence.unreadable.append("frames/1.mcap"),
    "frames_saved_are_recorded_once": lambda evidence: evidence.frames.update(list(evidence.frames)[:1]),
    "journal_and_recording_agree": lambda evidence: evidence.marks.pop(),
    "readings_are_true": misread,
    "frames_are_at_their_temperature": lambda evidence: changed(evidence, "bulk_air_degC", 40.0),
    "http_says_what_is_recorded": misread,
    "readings_go_on": lambda evidence: evidence.temperatures["air"].__delitem__(slice(50, 80)),
    "verify_finds_what_is_lost_and_nothing_else": lambda evidence: evidence.frames.popitem(),
    "ends_as_documented": lambda evidence: end(evidence, status=77),
    "is_completed_in_the_end": lambda evidence: end(evidence, status=1),
    "advice_says_what_to_mend": fail_thrice,
    "nobody_is_pestered": pester,
    "a_fit_holds_the_truth": blow_up,
    "heat_ends_with_the_program": stop_program,
    "a_stop_is_answered": press_stop,
    "nothing_is_left": lambda evidence: end(evidence, left=("python -m thermostand.foundation.worker_process",)),
}
"""For each invariant what is changed in the evidence, so that it must be found."""


def test_a_quiet_case_breaks_no_invariant(quiet: Evidence):
    assert quiet.is_complete
    assert sum(quiet.frames.values()) == 8
    assert violations(quiet) == []


@pytest.mark.parametrize("name", INVARIANTS)
def test_an_invariant_finds_what_it_forbids(quiet: Evidence, name: str):
    evidence = copy.deepcopy(quiet)
    evidence.__dict__["truth"] = [truth.copy() for truth in quiet.truth]
    evidence.__dict__["centres"] = {time_ns: centres.copy() for time_ns, centres in quiet.centres.items()}
    FORBIDDEN[name](evidence)
    assert list(INVARIANTS[name](evidence))


def test_a_seed_draws_the_same_case_and_a_case_is_read_as_it_was_written(tmp_path: Path):
    for seed, draws in itertools.product(range(40), (draw, draw_real)):
        case = draws(seed)
        assert case == draws(seed)
        assert len(case.faults) <= MOST_FAULTS
        (path := tmp_path / "case.yaml").write_text(write_case(case))
        assert read_case(path) == case


@pytest.mark.parametrize(
    ("needed", "tries"), [(("flap.jam",), 25), (("flap.jam", "pause"), 40), (("bus.cut", "camera.deaf", 9.0), 40)]
)
def test_a_broken_case_is_shrunk_to_what_breaks_it(
    monkeypatch: pytest.MonkeyPatch, needed: tuple[object, ...], tries: int
):
    """The search alone: a case counts as broken while it has these faults, orders and kills, and two cameras."""
    from tests.torture import rig

    def is_broken(case: Case) -> set[str]:
        has = {*(fault.name for fault in case.faults), *(order.verb for order in case.orders), *case.kills_s}
        return {"x"} if has >= set(needed) and case.stand["cameras"] == "2 cameras" else set[str]()

    names = (
        "bus.cut",
        "flap.jam",
        "flap.stall",
        "camera.deaf",
        "bus.noise",
        "flap.mute",
        "axis.alarm",
        "relays.silent",
    )
    faults = tuple(Fault(name, True, 5.0, 1800.0) for name in names)
    orders = tuple(Order(verb, 3.0) for verb in ("pause", "continue", "stop", "reset", "note", "state"))
    case = replace(draw(3), faults=faults, orders=orders, kills_s=(9.0, 11.0, 12.0), attended=True)
    case = replace(case, stand={**case.stand, "cameras": "2 cameras", "heat": "cts"})
    monkeypatch.setattr(rig, "perform", lambda case: rig.Result(case, (), (), 0.0, Counter(), Counter(), [], {}))
    monkeypatch.setattr(rig.Result, "broken", property(lambda self: is_broken(self.case)))
    least = shrink(case, {"x"}, tries)
    assert {fault.name for fault in least.faults} == {name for name in names if name in needed}
    assert [order.verb for order in least.orders] == [name for name in needed if name == "pause"]
    assert least.kills_s == tuple(each for each in needed if isinstance(each, float))
    done = shrink(least, {"x"}, 1000)
    assert done.stand == PLAIN | {"cameras": "2 cameras"}
    assert (done.attended, done.drawn_order, steps_of(done.plan)) == (False, False, 2)
    assert all(fault.for_s <= 20.0 for fault in done.faults)
