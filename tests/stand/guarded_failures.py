"""Twelve failures of the chamber's sensors, in three phases of a session, on drawn chambers: how hot does the air
get?"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection

from tests.stand.guarded_chamber import AIR, GRANITE, Action, Chamber, iterate_timed
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.guarding.rules import Announcements, make_watches
from thermostand.stand.safety.fault import Fault

LITTLE_K = 0.3  # how much too low a stuck probe is
AFTER_TRIP_S = 1200.0
HELD_S = 16 * 3600.0  # a set-point after the failure; the guard has to find it well before
HARMLESS_HELD_S = 4 * 3600.0  # and where it need not: nothing changes any more
# What the guard cannot see, and need not: the probe that controls is right.
HARMLESS = ("air stuck low", "PV and air exchanged")
_FORKS = multiprocessing.get_context("fork")


def _pv_low(chamber: Chamber) -> None:
    chamber.regulator.stuck_pv_degC = round(chamber.plant.chamber_degC - LITTLE_K, 1)


def _air_low(chamber: Chamber) -> None:
    """With the converter's noise: no constant value gives it away."""
    chamber.thermometers.held_degC = {AIR: chamber.plant.air_degC - LITTLE_K}


def _air_frozen(chamber: Chamber) -> None:
    chamber.thermometers.stuck_degC = {AIR: chamber.plant.air_degC - LITTLE_K}


def _granite_stuck(chamber: Chamber) -> None:
    chamber.thermometers.held_degC = {GRANITE: chamber.plant.granite_inside_degC}


def _pv_out(chamber: Chamber) -> None:
    chamber.regulator.probe_out = True


def _air_out(chamber: Chamber) -> None:
    chamber.thermometers.pulled_out = {AIR}


def _pv_drifts(chamber: Chamber) -> None:
    chamber.regulator.pv_drift_K_per_h = -1.0


def _air_drifts(chamber: Chamber) -> None:
    chamber.thermometers.drift_K_per_h = {AIR: -1.0}


def _exchange(chamber: Chamber) -> None:
    chamber.regulator.probe_exchanged = chamber.thermometers.air_exchanged = True


def _air_shorted(chamber: Chamber) -> None:
    chamber.thermometers.shorted_channels = {AIR}


def _all(*actions: Action) -> Action:
    def action(chamber: Chamber) -> None:
        for each in actions:
            each(chamber)

    return action


FAILURES: dict[str, Action] = {
    "PV stuck low": _pv_low,
    "air stuck low": _air_low,
    "both stuck low": _all(_pv_low, _air_low),
    "both stuck low, air without noise": _all(_pv_low, _air_frozen),
    "PV out of the chamber": _pv_out,
    "air out of the chamber": _air_out,
    "both out of the chamber": _all(_pv_out, _air_out),
    "PV drifts": _pv_drifts,
    "air drifts": _air_drifts,
    "both drift": _all(_pv_drifts, _air_drifts),
    "PV and air exchanged": _exchange,
    "air shorted": _air_shorted,
    "granite stuck, PV low": _all(_granite_stuck, _pv_low),
}
PHASES = ("heating", "holding", "cooling")
EARLY_S = 900.0  # at a set-point of which the guard has not learned yet how much heat it needs


@dataclass(frozen=True)
class Outcome:
    """The hottest the air's bulk became after the failure, what tripped and how long after it, s; None: nothing did."""

    hottest_degC: float
    fault: Fault | None
    after_s: float


def _nothing(chamber: Chamber) -> None: ...


def _set(set_point_degC: float) -> Action:
    return lambda chamber: chamber.set_temperature(set_point_degC)


def _phase(
    phase: str, hot_degC: float, held_s: float
) -> tuple[list[tuple[float, Action]], Callable[[float], bool], list[tuple[float, Action]]]:
    """What comes before, whether the air is where the sensors fail, and what comes after."""
    begin: list[tuple[float, Action]] = [(3600.0, lambda chamber: chamber.start(24.0))]
    if phase == "heating":
        middle_degC = (24.0 + hot_degC) / 2
        return [*begin, (0.0, _set(hot_degC))], lambda air: air >= middle_degC, [(held_s, _nothing)]
    hold: list[tuple[float, Action]] = [*begin, (EARLY_S if phase == "early" else 5400.0, _set(hot_degC))]
    if phase in ("holding", "early"):
        return hold, lambda air: True, [(held_s, _nothing)]
    after = [(3600.0, _nothing), (held_s, _set(hot_degC))]
    return [*hold, (0.0, _set(hot_degC - 14.0))], lambda air: air <= hot_degC - 7.0, after


class FailureRun:
    """A chamber at the instant of a phase at which its sensors fail, the guard's whole table looking at it."""

    def __init__(self, phase: str, config: StandConfig, chamber_seed: int | None, hot_degC: float) -> None:
        channels = {name: each.channel for name, each in config.sensors.items()}
        self._chamber = Chamber(chamber_seed, camera_powered=bool(config.cameras), channels=channels)
        self._table = make_watches(config, Announcements())
        self._phase, self._hot_degC = phase, hot_degC
        before, is_present, _ = _phase(phase, hot_degC, HELD_S)
        for now_ns in iterate_timed(self._chamber, before):
            assert (early := self._objection(now_ns)) is None, early
        while not is_present(self._chamber.plant.bulk_air_degC):
            assert (early := self._objection(self._chamber.poll())) is None, early

    def outcome(self, failure: str) -> Outcome:
        """Once: the session is over then."""
        chamber = self._chamber
        FAILURES[failure](chamber)
        failed_s, chamber.hottest_degC = chamber.time_s, chamber.plant.bulk_air_degC
        held_s = HARMLESS_HELD_S if failure in HARMLESS else HELD_S
        *_, after = _phase(self._phase, self._hot_degC, held_s)
        fault = self._first(iterate_timed(chamber, after))
        after_s = chamber.time_s - failed_s
        if fault is not None:
            chamber.stop()
            for _ in iterate_timed(chamber, [(AFTER_TRIP_S, _nothing)]):
                pass
        return Outcome(chamber.hottest_degC, fault, after_s)

    def outcomes(self, failures: Iterable[str]) -> dict[str, Outcome]:
        """Of each, as if it were the only one: it befalls a fork of this process, and forks work side by side."""
        lines = {failure: self._forked(failure) for failure in failures}
        return {failure: line.recv() for failure, line in lines.items()}

    def _forked(self, failure: str) -> Connection:
        receives, sends = _FORKS.Pipe(duplex=False)
        _FORKS.Process(target=lambda: sends.send(self.outcome(failure)), daemon=True).start()
        sends.close()  # so that reading from a fork that fails ends
        return receives

    def _first(self, polls: Iterator[int]) -> Fault | None:
        return next((fault for now_ns in polls if (fault := self._objection(now_ns)) is not None), None)

    def _objection(self, now_ns: int) -> Fault | None:
        faults = [watch.check(self._chamber.hub, now_ns) for watch in self._table]
        return next((fault for fault in faults if fault is not None and fault.action != "warn"), None)


def table(outcomes: dict[tuple[str, str], list[Outcome]]) -> str:
    """One line for each failure and phase: how hot at most, the slowest trip, and what tripped."""
    lines = [f"{'failure':34} {'phase':8} {'hottest/degC':>12} {'slowest/s':>10}  by"]
    for (failure, phase), found in outcomes.items():
        hottest_degC = max(each.hottest_degC for each in found)
        rules = sorted({each.fault.rule if each.fault else "-" for each in found})
        slowest_s = max((each.after_s for each in found if each.fault), default=float("nan"))
        lines.append(f"{failure:34} {phase:8} {hottest_degC:12.1f} {slowest_s:10.0f}  {', '.join(rules)}")
    return "\n".join(lines)
