"""Which of two channels that contradict each other moved unlike the rest.

The rest are the other thermometers in that air, the bodies that follow it (granite, camera), and the heat that was
given. A body of lag L and excess e follows the air T by dB/dt = (T + e - B) / L: had it stood in air as one of the two
shows it, it would be where that equation leads. What is left, divided by the share of a step that it follows in that
time, is the error of that channel in K of the air.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from thermostand.foundation.clock import NS_PER_S
from thermostand.stand.config.chamber_section import ChamberConfig
from thermostand.stand.guarding.heat_balance import compute_heat_percent
from thermostand.stand.safety.fault import Fault, Readings, Rule, get_value, is_suspect

_EVERY_S, _KEPT_S = 10.0, 3600.0
_BEFORE_S = 300.0  # from which a body's own trend is taken
_AGREED_K = 0.15  # beyond the least that they were apart within the hour: then they still agreed
_BODY_BACK_S = 900.0  # for a body and a probe, which never show the same
_SURE_K, _LAG_ERROR = 1.0, 0.3  # a witness decides beyond this, and this share of how far the air has gone
_REST_K, _REST_PERCENT = 0.5, 5.0  # air, and a heater's output, that stay within these are at rest
_MOVED_K, _EXTRA_K = 0.7, 1.5  # from rest; what the heat beyond that of the rest would make of the air
_HARD_PERCENT, _GIVEN_K, _RESPONSE_SHARE = 50.0, 1.0, 0.15
"""Of such an output, which is more than any rest needs, both must show the share of what it makes of the air."""


@dataclass(frozen=True, slots=True)
class Suspicion:
    """suspect: the channel, "" when it cannot be determined. by: what speaks against it."""

    suspect: str = ""
    by: tuple[str, ...] = ()

    def words(self, pair: tuple[str, str]) -> str:
        """The diagnosis as the end of a sentence that names both."""
        if not self.suspect:
            return f"; whether {pair[0]} or {pair[1]} is wrong cannot be determined from what else is measured"
        if not self.by:
            return f"; {self.suspect} is the suspect one, the other is not"
        return f"; {self.suspect} moved unlike the rest ({', '.join(self.by)})"


class SensorHistory:
    """What the channels of one air have done within the last hour. in_air: those that show it at once; bodies: lag, s,
    of those that follow it. heat: regulator and permit, for what was given; none where that is not known. causes: what
    else moves that air when it changes, such as the flap. cold: set-point and compressor."""

    def __init__(
        self,
        in_air: Sequence[str],
        bodies: Mapping[str, float],
        chamber: ChamberConfig,
        heat: tuple[str, str] | None = None,
        causes: Sequence[str] = (),
        cold: tuple[str, str] | None = None,
    ) -> None:
        self._in_air = tuple(in_air)
        self._bodies = dict(bodies)
        self._chamber = chamber
        self._heat = heat
        self._times_s: list[float] = []
        self._values: dict[str, list[float]] = {name: [] for name in (*in_air, *bodies)}
        self._given_Wh: list[float] = []  # since the begin
        self._percent: list[float] = []
        self._causes = tuple(dict.fromkeys((*causes, *(cold or ()))))
        self._cold = None if cold is None else (self._causes.index(cold[0]), self._causes.index(cold[1]))
        self._caused: list[tuple[float, ...]] = []
        self._steps_K: dict[str, float] = {}

    def note(self, readings: Readings, now_ns: int) -> None:
        """One more look; several within 10 s count once."""
        now_s = now_ns / NS_PER_S
        since_s = now_s - self._times_s[-1] if self._times_s else math.inf
        if since_s < _EVERY_S:
            return
        percent = compute_heat_percent(readings, *self._heat) if self._heat is not None else math.nan
        before_Wh = self._given_Wh[-1] if self._given_Wh else 0.0
        given_Wh = percent / 100 * self._chamber.heater_W * min(since_s, 6 * _EVERY_S) / 3600
        self._times_s.append(now_s)
        self._given_Wh.append(before_Wh + given_Wh)
        self._percent.append(percent)
        self._caused.append(tuple(get_value(readings, each) for each in self._causes))
        for name, values in self._values.items():
            value = _get_trusted_value(readings, name)
            if values and (step_K := abs(value - values[-1])) > 0:
                self._steps_K[name] = min(self._steps_K.get(name, math.inf), step_K)
            values.append(value)
        if now_s - self._times_s[0] > _KEPT_S:
            for column in (self._times_s, self._given_Wh, self._percent, self._caused, *self._values.values()):
                del column[0]

    def find_suspect(self, pair: tuple[str, str], readings: Readings) -> Suspicion:
        """Find which of both moved unlike the rest."""
        suspects = [name for name in pair if is_suspect(readings, name)]
        if len(suspects) == 1:
            return Suspicion(suspects[0])
        now = {name: get_value(readings, name) for name in pair}
        begin = self._find_last_agreement(pair, now)
        against: dict[str, list[str]] = {name: [] for name in pair}
        for witness in self._values:
            if witness not in pair and (found := self._weigh_witness(witness, pair, now, begin, readings)):
                against[found].append(witness)
        has_witness = any(against.values())  # one that measures shows what no heat, cold or flap explains
        if not has_witness and begin is not None and not any(name in self._bodies for name in pair):
            if found := self._judge_by_heat(pair, now, begin):
                against[found].append("the heat that was given")
            if found := self._judge_by_cold(pair, now, begin):
                against[found].append("the cold that was given")
            if found := self._judge_by_rest(pair, now, begin):
                against[found].append("heat, cold and flap since then")
        first, second = (len(against[name]) for name in pair)
        if first == second:
            return Suspicion()
        suspect = pair[0] if first > second else pair[1]
        return Suspicion(suspect, tuple(against[suspect]))

    def _find_last_agreement(self, pair: tuple[str, str], now: Mapping[str, float]) -> int | None:
        """The last look at which they were together; of a body and a probe one some time ago."""
        if not self._times_s:
            return None
        if any(name in self._bodies for name in pair):
            wanted_s = self._times_s[-1] - _BODY_BACK_S
            return next((i for i, time_s in enumerate(self._times_s[:-1]) if time_s >= wanted_s), None)
        apart_K = [abs(a - b) for a, b in zip(*(self._values[name] for name in pair), strict=True)]
        limit_K = min((each for each in apart_K if not math.isnan(each)), default=math.nan) + _AGREED_K
        if not limit_K < abs(now[pair[0]] - now[pair[1]]) - _MOVED_K:
            return None
        return next(i for i in reversed(range(len(apart_K))) if apart_K[i] <= limit_K)

    def _weigh_witness(
        self, witness: str, pair: tuple[str, str], now: Mapping[str, float], begin: int | None, readings: Readings
    ) -> str:
        """Return which of both the other sensor contradicts, "" for none."""
        seen = _get_trusted_value(readings, witness)
        if math.isnan(seen):
            return ""
        wrong_K, least_K = [0.0, 0.0], _SURE_K
        for number, name in enumerate(pair):
            if witness in self._in_air and name in self._in_air:
                gone_K = 0.0 if begin is None else self._values[witness][begin] - self._values[name][begin]
                wrong_K[number] = abs(seen - now[name] - gone_K)
                continue
            air, body = (name, witness) if witness in self._bodies else (witness, name)
            if begin is None or air in self._bodies:
                return ""
            off_K, share = self._compute_lag_error_K(air, body, begin)
            wrong_K[number] = abs(off_K)
            gone_K = min(abs(now[each] - self._values[each][begin]) for each in pair if each in self._in_air)
            least_K = max(least_K, _SURE_K + 2 * self._steps_K.get(body, 0.0) / share + _LAG_ERROR * gone_K)
        worse, better = max(wrong_K), min(wrong_K)
        if not (worse - better > least_K and worse > 2 * better):
            return ""
        return pair[wrong_K.index(worse)]

    def _compute_lag_error_K(self, air: str, body: str, begin: int) -> tuple[float, float]:
        """Return how far the body is from where air as that channel shows it would have brought it, in K of the air;
        and the share of a step that it follows since `begin`."""
        times_s, aired, bodied, lag_s = self._times_s, self._values[air], self._values[body], self._bodies[body]
        trend_K_s = _fit_trend(
            [
                (time_s, value)
                for time_s, value in zip(times_s[: begin + 1], bodied[: begin + 1], strict=True)
                if time_s >= times_s[begin] - _BEFORE_S
            ]
        )
        excess_K = bodied[begin] + lag_s * trend_K_s - aired[begin]
        follows_degC = bodied[begin]
        for i in range(begin + 1, len(times_s)):
            share = 1.0 - math.exp(-(times_s[i] - times_s[i - 1]) / lag_s)
            follows_degC += share * ((aired[i] + aired[i - 1]) / 2 + excess_K - follows_degC)
        share = max(1e-6, 1.0 - math.exp(-(times_s[-1] - times_s[begin]) / lag_s))
        return (bodied[-1] - follows_degC) / share, share

    def _judge_by_heat(self, pair: tuple[str, str], now: Mapping[str, float], begin: int) -> str:
        """One of both that stays where it is, or falls, while so much heat was given that the other rose."""
        percent = self._percent[begin:]
        expected_K = (self._given_Wh[-1] - self._given_Wh[begin]) / self._chamber.heat_capacity_Wh_K
        if not (expected_K >= _GIVEN_K and sum(percent) / len(percent) >= _HARD_PERCENT):
            return ""
        risen_K = {name: now[name] - self._values[name][begin] for name in pair}
        unfelt = [name for name in pair if risen_K[name] < _RESPONSE_SHARE * expected_K]
        return unfelt[0] if len(unfelt) == 1 else ""

    def _judge_by_cold(self, pair: tuple[str, str], now: Mapping[str, float], begin: int) -> str:
        """One of both that does not fall, while the other does, and the compressor cools without heat towards a
        set-point below both."""
        if self._cold is None or not all(percent <= 0 for percent in self._percent[begin:]):
            return ""
        set_point, compressor = self._cold
        cooled = all(each[compressor] == 1 for each in self._caused[begin:])
        if not (cooled and self._caused[-1][set_point] < min(now[name] for name in pair) - _SURE_K):
            return ""
        fallen_K = {name: self._values[name][begin] - now[name] for name in pair}
        unfelt = [name for name in pair if fallen_K[name] < _RESPONSE_SHARE * max(fallen_K.values())]
        return unfelt[0] if len(unfelt) == 1 and max(fallen_K.values()) >= _MOVED_K else ""

    def _judge_by_rest(self, pair: tuple[str, str], now: Mapping[str, float], begin: int) -> str:
        """Judge from air at rest: return the one of both that moved though nothing that moves it has changed, or the
        one that stayed though the heat has."""
        first = next((i for i, time_s in enumerate(self._times_s) if time_s >= self._times_s[begin] - _BEFORE_S), begin)
        before = [self._values[name][first : begin + 1] for name in pair]
        rest_percent = self._percent[first : begin + 1]
        is_at_rest = (
            self._times_s[begin] - self._times_s[first] >= _BEFORE_S / 2
            and max(rest_percent) - min(rest_percent) <= _REST_PERCENT
            and all(max(each) - min(each) <= _REST_K for each in before)
            and all(each == self._caused[first] for each in self._caused[first:])
        )
        if not is_at_rest:
            return ""
        lasted_h = (self._times_s[-1] - self._times_s[begin]) / 3600
        needed_Wh = sum(rest_percent) / len(rest_percent) / 100 * self._chamber.heater_W * lasted_h
        extra_K = (self._given_Wh[-1] - self._given_Wh[begin] - needed_Wh) / self._chamber.heat_capacity_Wh_K
        gone_K = [now[name] - sum(each) / len(each) for name, each in zip(pair, before, strict=True)]
        if abs(extra_K) < _EXTRA_K:
            most_K = max(_MOVED_K, abs(extra_K) / _LAG_ERROR)
            moved = [name for name, each in zip(pair, gone_K, strict=True) if abs(each) >= most_K]
            return moved[0] if len(moved) == 1 and lasted_h <= _BEFORE_S / 3600 else ""
        unfelt = [name for name, each in zip(pair, gone_K, strict=True) if each / extra_K < _RESPONSE_SHARE]
        return unfelt[0] if len(unfelt) == 1 else ""


def name_suspect(rule: Rule, pair: tuple[str, str], witnesses: SensorHistory, *, compares: bool = True) -> Rule:
    """A rule that compares two channels, whose fault names both and says which one moved unlike the rest. One that does
    not compare them, but judges by the first, says it only when it can be determined."""

    def judge(readings: Readings, now_ns: int) -> Fault | None:
        witnesses.note(readings, now_ns)
        fault = rule(readings, now_ns)
        if fault is None:
            return None
        found = witnesses.find_suspect(pair, readings)
        if not (compares or found.suspect):
            return fault
        return replace(fault, text=fault.text + found.words(pair), channels=pair, suspect=found.suspect)

    return judge


def _get_trusted_value(readings: Readings, channel: str) -> float:
    return math.nan if is_suspect(readings, channel) else get_value(readings, channel)


def _fit_trend(points: Sequence[tuple[float, float]]) -> float:
    """Fit a slope by least squares, K/s; 0 with fewer than five points."""
    if len(points) < 5:
        return 0.0
    middle_s = sum(time_s for time_s, _ in points) / len(points)
    spread_s2 = sum((time_s - middle_s) ** 2 for time_s, _ in points)
    return sum((time_s - middle_s) * value for time_s, value in points) / spread_s2
