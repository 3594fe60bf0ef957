"""One check of every temperature that a model or a rule uses: outside its range, jumped, noisy, or stuck.

Each channel is judged against itself: how fast it can move (the lag of what it measures), the steps in which it is
shown, and the channel that it follows. What is suspect is recorded as STALE with cause "suspect"; it stays a reading,
for whether heat may go on is the guard's business. No reading shows that it is wrong before it jumps, so that one which
is wrong from the beginning is found only where physics says so: a camera that is at rest is warmer than its air.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from statistics import median

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.events import SENSOR, SENSOR_BELIEVED, get_guard_kind, guard_rule
from thermostand.foundation.items import Event
from thermostand.foundation.readings import Quality, Reading
from thermostand.stand.config.guard_section import SensorsConfig
from thermostand.stand.guarding.interlocks import SENSOR_STALE
from thermostand.stand.guarding.stuck_sensor import FINE_STEP_K, SENSOR_STUCK
from thermostand.stand.safety.fault import Fault

SENSOR_JUMPED = guard_rule("sensor_jumped", "a temperature jumped by more than a body can", SENSOR)
SENSOR_OUTSIDE = guard_rule("sensor_outside", "a temperature is where it cannot be", SENSOR)
SENSOR_NOISY = guard_rule("sensor_noisy", "a temperature is noisier than it was", SENSOR)
SENSOR_IMPLAUSIBLE = guard_rule(
    "sensor_implausible",
    "a camera is warmer or colder than its own heat can make it",
    "state `self_heating_K` of the camera in the stand's file, if that is how it is; " + SENSOR,
)
Poll = tuple[Reading, ...]

# Half of it is less than a step of the recipes, and would suspect a body after a gap; twice lets a jump in a gap pass
# that is twice as large.
_DRIVE_K = 50.0
"""How far from a body its surroundings, or its own heat, may draw it: the largest step of the installed recipes is 36 K
and the warmest camera 25 K above the air. In a gap a body of lag L can go no further than 1 - exp(-gap / L) of it."""
# Half of 40 K is less than the 22 K of published chips.
_CHIP_K, _CHIP_LAG_S = 40.0, 60.0
"""A chip on its board warms by so much within some minutes of switching on, and loses it as fast: those of the
published cameras go up to 22 K, with lags between 40 and 130 s."""
_JUMP_WITHIN_S = 15.0  # three polls of the slowest kind: in a longer gap a body may go further
_STUCK_AFTER_S = 900.0  # exactly constant in fine steps: longer than any noise of a converter rests
_STALE_AFTER_S, _AIR_MOVES_K = 600.0, 3.0  # a camera that has not moved so long after its air went so far is stale
LEAST_LAG_S = 10.0  # of a Pt100 in moving air
_SLOW_S = 100.0  # a body with at least this lag cannot run away within a minute, one with less can
_WINDOW_S = 60.0  # over which a slow body's rate is looked at
_TREND_S = (4.0, 20.0)  # between the readings of which a trend is made
_TREND_K = 4.0  # that a trend may promise: full heat makes up to 0.5 K/s in the smallest of the drawn chambers
# Half of 1 K is still 25 times what good sessions have; twice would not find a noise of 1 K.
_NOISE_POLLS, _NOISE_K = 12, 1.0
"""The median of second differences: 0.02 K in good sessions, 1.65 K with a noise of 1 K (standard deviation)."""
_TOGETHER_S = 15.0  # what moves within this, on other devices, moved with it
_BACK_S = 1800.0  # for so long a channel must be as far from the one that it follows as it was before it jumped
_STILL_K = 2.0  # air that stays within this is at rest, as far as a camera notices
# 5 % of a step are left then, 22 % after half of it.
_REST_LAGS = 3.0  # after so many lags in air at rest a camera is at rest, too
_REST_K, _OWN_REST_LAGS = 1.0, 2.0
"""A camera that stayed within so much for so many of its configured lags has warmed up: the lag is a guess, and one of
a hundred drawn sessions had a camera three times as slow, still warming up in air at rest."""
_STEPS_BEHIND, _SLOWER, _FINE_STEP_K, _YOUNG_LAGS = 5.0, 3.0, 0.2, 10.0
"""Steps of a display that a camera must have gone before it counts as stuck, with up to three times its configured lag.
One coarser than 0.2 K needs more, in proportion, while it may still warm up: of 260 drawn sessions one had a camera in
steps of 0.5 K that stood still for 35 min while its own heat and air that fell by 18 K balanced each other."""
# Half of it leaves 0.5 K above the 2.5 K of radiation and granite.
_EXCESS_K = 6.0  # from rest to rest: radiation and the granite make up to 2.5 K of it between -10 and 60 degC
_SAME_K = 1e-6  # a rounding, no step of a display


@dataclass(frozen=True, slots=True)
class ChannelModel:
    """What is known of a channel beforehand. lag_s: how long what it measures takes for two thirds of a step. follows:
    the channel of what surrounds it, "" where none is measured. excess_K: how far above that it is at rest, lowest and
    highest; None where it has no heat of its own. range_degC: outside, it is no measurement."""

    range_degC: tuple[float, float]
    lag_s: float = LEAST_LAG_S
    follows: str = ""
    excess_K: tuple[float, float] | None = None


@dataclass(slots=True)
class _Suspicion:
    """Why a channel is suspect, since when; how far it jumped in all, K, and how far from what it follows it was."""

    fault: Fault
    time_ns: int
    moved_K: float = 0.0
    before_K: float = math.nan
    as_before_ns: int | None = None

    @property
    def rule(self) -> str:
        """The name of the rule."""
        return self.fault.rule

    @property
    def text(self) -> str:
        """The reason in words."""
        return self.fault.text


@dataclass(slots=True)
class _ChannelState:
    """One channel so far; `begin_ns` after a gap in which anything may have happened to it."""

    value: float
    time_ns: int
    begin_ns: int
    changed_ns: int
    recent: deque[tuple[int, float]]
    polled: deque[float] = field(default_factory=lambda: deque(maxlen=_NOISE_POLLS + 2))
    step_K: float = math.inf  # the smallest between two readings
    followed_degC: tuple[float, float] = (math.inf, -math.inf)  # lowest and highest since it last changed
    went_ns: int | None = None  # since when that is far apart
    rest_degC: float = math.nan  # of what it follows, at rest since
    rest_ns: int = 0
    rest_K: float = math.nan  # above it, when both were last at rest
    still_degC: float = math.nan  # where it has stayed itself, since
    still_ns: int = 0
    suspicion: _Suspicion | None = None


class ChannelCheck:
    """All channels of a stand, by `natures`; a reading of any other passes. publish: takes the events."""

    def __init__(
        self, natures: Mapping[str, ChannelModel], sensors: SensorsConfig, publish: Callable[[Event], None]
    ) -> None:
        self._natures = natures
        self._sensors = sensors
        self._publish = publish
        self._seen: dict[str, _ChannelState] = {}
        self._jumped_ns: dict[str, int] = {}

    def make_marker(self, module: str) -> Callable[[Poll, int], Poll]:
        """Return what is to be published of each poll of a device, which is called `module` where several of its
        channels move at once."""

        def mark(readings: Poll, now_ns: int) -> Poll:
            known = [each for each in readings if each.channel in self._natures]
            fine_K = min((self._seen[each.channel].step_K for each in known if each.channel in self._seen), default=0)
            began: list[tuple[str, _Suspicion]] = []
            for reading in known:
                if reading.quality is not Quality.BAD:
                    began += self._judge(reading.channel, reading.value, reading.time_ns, fine_K, is_poll=True)
                elif reading.cause != "wire" and reading.channel in self._seen:  # such as a camera that is off
                    self._seen[reading.channel].begin_ns = reading.time_ns
            self._report(began, module, [each.channel for each in known], now_ns)
            return tuple(self._mark(reading) for reading in readings)

        return mark

    def judge_value(self, channel: str, value: float, time_ns: int) -> str:
        """Return why one more reading of the channel, which came with a frame, is not to be believed; "" when it is."""
        if channel not in self._natures or math.isnan(value):
            return ""
        self._report(self._judge(channel, value, time_ns, math.inf, is_poll=False), channel, [channel], time_ns)
        suspect = self._seen[channel].suspicion
        return "" if suspect is None else suspect.text

    def _mark(self, reading: Reading) -> Reading:
        seen = self._seen.get(reading.channel)
        if seen is None or seen.suspicion is None or reading.quality is Quality.BAD:
            return reading
        return replace(reading, quality=Quality.STALE, reason=seen.suspicion.text, cause="suspect")

    def _judge(
        self, channel: str, value: float, time_ns: int, fine_K: float, *, is_poll: bool
    ) -> list[tuple[str, _Suspicion]]:
        """List the suspicions that begin with one more reading."""
        nature, seen = self._natures[channel], self._seen.get(channel)
        if seen is not None and time_ns <= seen.time_ns:
            return []
        if seen is None or (time_ns - seen.time_ns) / NS_PER_S > max(_WINDOW_S, nature.lag_s):
            before = seen
            seen = self._seen[channel] = _ChannelState(value, time_ns, time_ns, time_ns, deque([(time_ns, value)]))
            if before is not None:
                seen.step_K, seen.rest_K = before.step_K, before.rest_K
        elif (time_ns - seen.time_ns) / NS_PER_S > _WINDOW_S:
            seen.begin_ns = time_ns
        was = seen.suspicion
        self._follow(seen, nature, value, time_ns)
        has_jumped = abs(_measure_beyond_K(seen, value, time_ns)) > self._allowed_K(seen, nature, time_ns)
        if was is not None and was.rule == SENSOR_JUMPED:
            self._watch_return(channel, seen, was, value, time_ns, has_jumped=has_jumped)
        elif was is None and has_jumped:
            self._jump(channel, seen, value, time_ns, (seen.time_ns, seen.value))
        elif was is None and self._has_run_away(seen, nature, value, time_ns):
            self._jump(channel, seen, value, time_ns, seen.recent[0])
        _record_value(seen, value, time_ns, is_poll=is_poll)
        self._judge_lasting(channel, seen, nature, fine_K)
        now = seen.suspicion
        if now is None and was is not None:
            self._report_trusted(channel, value, was, time_ns)
        is_new = now is not None and (was is None or (now is not was and now.rule != was.rule))
        return [(channel, now)] if now is not None and is_new else []

    def _follow(self, seen: _ChannelState, nature: ChannelModel, value: float, time_ns: int) -> None:
        """Return where what it follows has been since it last changed, and since when that is at rest."""
        if value != seen.value:
            seen.changed_ns, seen.went_ns, seen.followed_degC = time_ns, None, (math.inf, -math.inf)
        followed_degC = self._get_trusted_degC(nature.follows)
        if math.isnan(followed_degC):
            return
        lowest, highest = seen.followed_degC
        seen.followed_degC = (min(lowest, followed_degC), max(highest, followed_degC))
        if not abs(followed_degC - seen.rest_degC) <= _STILL_K:
            seen.rest_degC, seen.rest_ns = followed_degC, time_ns

    def _get_trusted_degC(self, channel: str) -> float:
        """The last value of another channel, NaN when there is none, or that one is suspect itself."""
        other = self._seen.get(channel)
        return math.nan if other is None or other.suspicion is not None else other.value

    def _allowed_K(self, seen: _ChannelState, nature: ChannelModel, time_ns: int) -> float:
        """Return how far one reading may be from where the last ones lead: a step of the display, what a longer gap
        leaves space for, and as far as its surroundings have gone while it stood still."""
        gap_s = max(0.0, (time_ns - seen.time_ns) / NS_PER_S - _JUMP_WITHIN_S)
        still_s = (time_ns - seen.changed_ns) / NS_PER_S
        went_K = max(0.0, seen.followed_degC[1] - seen.followed_degC[0]) * _compute_share(still_s, nature.lag_s)
        own_K = _compute_own_heat_K(seen, nature, seen.time_ns, time_ns)
        return (
            self._sensors.jump_K + _get_step_K(seen) + _DRIVE_K * _compute_share(gap_s, nature.lag_s) + went_K + own_K
        )

    def _has_run_away(self, seen: _ChannelState, nature: ChannelModel, value: float, time_ns: int) -> bool:
        """A slow body that goes faster, for a minute, than anything can make it."""
        if nature.lag_s < _SLOW_S or not seen.recent:
            return False
        first_ns, first = seen.recent[0]
        window_s = (time_ns - first_ns) / NS_PER_S
        most_K = self._sensors.jump_K + _get_step_K(seen) + _DRIVE_K * _compute_share(window_s, nature.lag_s)
        return abs(value - first) > most_K + _compute_own_heat_K(seen, nature, first_ns, time_ns)

    def _jump(self, channel: str, seen: _ChannelState, value: float, time_ns: int, since: tuple[int, float]) -> None:
        self._jumped_ns[channel] = time_ns
        after_s, went_K = (time_ns - since[0]) / NS_PER_S, value - since[1]
        text = f"{channel} went by {went_K:+.2f} K within {after_s:.3g} s, to {value:.2f} degC"
        nature = self._natures[channel]
        is_known = nature.lag_s < _SLOW_S or self._is_at_rest(
            seen, nature
        )  # what a slow body was on the way counts not
        before_K = since[1] - self._get_trusted_degC(nature.follows) if is_known else math.nan
        seen.suspicion = _Suspicion(Fault(SENSOR_JUMPED, text, "warn"), time_ns, went_K, before_K)
        seen.recent.clear()  # no trend leads over a jump

    def _watch_return(
        self, channel: str, seen: _ChannelState, was: _Suspicion, value: float, time_ns: int, *, has_jumped: bool
    ) -> None:
        """One that has jumped is believed again when it jumps back, or when it is for a while as far from what it
        follows as it was before."""
        nature = self._natures[channel]
        if has_jumped:
            was.moved_K += value - seen.value
            self._jumped_ns[channel] = time_ns
            seen.recent.clear()
        away_K = value - self._get_trusted_degC(nature.follows) - was.before_K
        is_as_before = abs(away_K) <= self._sensors.jump_K / 2 + _get_step_K(seen)
        if has_jumped and (is_as_before or abs(was.moved_K) <= self._allowed_K(seen, nature, time_ns)):
            seen.suspicion = None
        elif not is_as_before:
            was.as_before_ns = None
        elif was.as_before_ns is None:
            was.as_before_ns = time_ns
        elif (time_ns - was.as_before_ns) / NS_PER_S >= _BACK_S:
            seen.suspicion = None

    def _judge_lasting(self, channel: str, seen: _ChannelState, nature: ChannelModel, fine_K: float) -> None:
        """Judge what is wrong for as long as it lasts; a jump stays one."""
        found = (
            self._check_range(channel, seen, nature)
            or self._check_noise(channel, seen)
            or self._check_stuck(channel, seen, nature, fine_K)
            or self._check_excess(channel, seen, nature)
        )
        was = seen.suspicion
        if found is None:
            seen.suspicion = was if was is not None and was.rule == SENSOR_JUMPED else None
        elif was is None or was.rule not in (found.rule, SENSOR_JUMPED) or found.rule == SENSOR_NOISY != was.rule:
            seen.suspicion = found

    def _check_range(self, channel: str, seen: _ChannelState, nature: ChannelModel) -> _Suspicion | None:
        low_degC, high_degC = nature.range_degC
        if low_degC <= seen.value <= high_degC:
            return None
        text = f"{channel} is {seen.value:.2f} degC, outside {low_degC:g}..{high_degC:g} degC"
        return _Suspicion(Fault(SENSOR_OUTSIDE, text, "warn"), seen.time_ns)

    def _check_noise(self, channel: str, seen: _ChannelState) -> _Suspicion | None:
        last = list(seen.polled)
        if len(last) < _NOISE_POLLS + 2:
            return None
        bends_K = [abs(c - 2 * b + a) for a, b, c in zip(last, last[1:], last[2:], strict=False)]
        was_noisy = seen.suspicion is not None and seen.suspicion.rule == SENSOR_NOISY
        limit_K = _NOISE_K * (0.5 if was_noisy else 1.0) + 2 * _get_step_K(seen)
        if median(bends_K) <= limit_K:
            return None
        text = f"{channel} scatters by {median(bends_K) / 1.65:.1f} K from reading to reading"
        return _Suspicion(Fault(SENSOR_NOISY, text, "warn"), seen.time_ns)

    def _check_stuck(self, channel: str, seen: _ChannelState, nature: ChannelModel, fine_K: float) -> _Suspicion | None:
        """Exactly constant: for long, where the device shows steps so fine that noise must move it; or since what it
        follows has gone so far that it must have gone several steps, too."""
        still_s = (seen.time_ns - seen.changed_ns) / NS_PER_S
        if fine_K <= FINE_STEP_K and still_s >= _STUCK_AFTER_S:
            text = f"{channel} has been exactly {seen.value:.3f} degC for {_STUCK_AFTER_S:g} s"
            return _Suspicion(Fault(SENSOR_STUCK, text, "warn"), seen.time_ns)
        went_K = seen.followed_degC[1] - seen.followed_degC[0]
        step_K = 0.0 if math.isinf(seen.step_K) else seen.step_K
        share = _compute_share(_STALE_AFTER_S, nature.lag_s)
        needed_K = _STEPS_BEHIND * step_K / _compute_share(_STALE_AFTER_S, _SLOWER * nature.lag_s)
        if nature.excess_K is not None and (seen.time_ns - seen.begin_ns) / NS_PER_S < _YOUNG_LAGS * nature.lag_s:
            needed_K *= max(1.0, step_K / _FINE_STEP_K)
        # For a camera of the usual lag of 600 s the share is 0.63, and the limit is that of the air itself.
        if not went_K >= max(_AIR_MOVES_K / min(1.0, 1.6 * share), needed_K):
            return None
        seen.went_ns = seen.went_ns or seen.time_ns
        if (seen.time_ns - seen.went_ns) / NS_PER_S < _STALE_AFTER_S:
            return None
        text = f"{channel} stays at {seen.value:g} while {nature.follows} went by {went_K:.1f} K; it is stale"
        return _Suspicion(Fault(SENSOR_STALE, text, "warn"), seen.time_ns)

    def _is_at_rest(self, seen: _ChannelState, nature: ChannelModel) -> bool:
        """A slow body, on for long in air that has not moved for long, and still itself."""
        in_air_s = (seen.time_ns - max(seen.rest_ns, seen.begin_ns)) / NS_PER_S
        still_s = (seen.time_ns - seen.still_ns) / NS_PER_S
        return in_air_s >= _REST_LAGS * nature.lag_s and still_s >= _OWN_REST_LAGS * nature.lag_s

    def _check_excess(self, channel: str, seen: _ChannelState, nature: ChannelModel) -> _Suspicion | None:
        """A camera at rest, in air at rest, against what is known of its own heat: stated, and what it was before."""
        followed_degC = self._get_trusted_degC(nature.follows)
        if nature.excess_K is None or math.isnan(followed_degC):
            return None
        if not self._is_at_rest(seen, nature):
            return None
        excess_K, slack_K = seen.value - followed_degC, self._sensors.jump_K + _get_step_K(seen)
        low_K, high_K = nature.excess_K
        above = f"{channel} is {excess_K:+.1f} K from {nature.follows}, both at rest"
        if not low_K - slack_K <= excess_K <= high_K + slack_K:
            wanted = f"{low_K:g} to {high_K:g} K" if math.isfinite(high_K) else f"more than {low_K:g} K"
            return _Suspicion(Fault(SENSOR_IMPLAUSIBLE, f"{above}; {wanted} are expected", "warn"), seen.time_ns)
        if math.isnan(seen.rest_K) and seen.suspicion is None:
            seen.rest_K = excess_K
        if abs(excess_K - seen.rest_K) > _EXCESS_K:
            return _Suspicion(
                Fault(SENSOR_IMPLAUSIBLE, f"{above}; it was {seen.rest_K:+.1f} K before", "warn"), seen.time_ns
            )
        return None

    def _report(self, began: list[tuple[str, _Suspicion]], module: str, channels: list[str], now_ns: int) -> None:
        """One event for what jumps at one instant, one for each that is suspect for another reason."""
        jumped = [(channel, suspect) for channel, suspect in began if suspect.rule == SENSOR_JUMPED]
        for channel, suspicion in began:
            if suspicion.rule != SENSOR_JUMPED:
                self._warn(suspicion.rule, [channel], suspicion.text, now_ns, {})
        if not jumped:
            return
        names = [channel for channel, _ in jumped]
        with_it = [
            name
            for name, time_ns in self._jumped_ns.items()
            if name not in channels and now_ns - time_ns <= _TOGETHER_S * NS_PER_S
        ]
        moved: dict[str, object] = {"moved_K": {channel: round(each.moved_K, 3) for channel, each in jumped}}
        text = "; ".join(suspicion.text for _, suspicion in jumped)
        if with_it:
            moved["together_with"] = with_it
            text = f"{text}; with it moved {', '.join(with_it)}: look at what they share, not at single cables"
        elif len(jumped) == 1:
            text += ": look at its cable"
        elif self._are_exchanged(jumped):
            moved["exchanged"] = True
            text = f"each shows what the other showed: look whether their cables were exchanged: {text}"
        else:
            moved["module"] = module
            text = (
                f"{len(jumped)} of {len(channels)} temperatures of {module} moved in one poll: look at that module, "
                f"its range and its supply, not at single cables: {text}"
            )
        self._warn(SENSOR_JUMPED, names, text, now_ns, moved)

    def _are_exchanged(self, jumped: list[tuple[str, _Suspicion]]) -> bool:
        if len(jumped) != 2:
            return False
        now, before = zip(
            *((self._seen[name].value, self._seen[name].value - each.moved_K) for name, each in jumped), strict=True
        )
        slack_K = self._sensors.jump_K / 4
        return abs(now[0] - before[1]) <= slack_K and abs(now[1] - before[0]) <= slack_K

    def _warn(self, rule: str, channels: list[str], text: str, now_ns: int, more: Mapping[str, object]) -> None:
        data: dict[str, object] = {"rule": rule, "action": "warn", "channels": channels, **more}
        self._publish(get_guard_kind(rule).at(now_ns, text, **data))

    def _report_trusted(self, channel: str, value: float, was: _Suspicion, now_ns: int) -> None:
        lasted_s = (now_ns - was.time_ns) / NS_PER_S
        data = {"rule": was.rule, "channels": [channel], "suspect_s": lasted_s, "value_degC": value}
        self._publish(SENSOR_BELIEVED.at(now_ns, was.text, **data))


def _compute_share(time_s: float, lag_s: float) -> float:
    """The share of a step that a body of that lag has followed after that time."""
    return 1.0 - math.exp(-time_s / lag_s)


def _compute_own_heat_K(seen: _ChannelState, nature: ChannelModel, from_ns: int, to_ns: int) -> float:
    """Return how far its own heat may have moved it, which it has since its begin; before that it may have been off."""
    if nature.excess_K is None:
        return 0.0
    off_s = max(0, seen.begin_ns - from_ns) / NS_PER_S
    since_s, until_s = (max(0, each - seen.begin_ns) / NS_PER_S for each in (from_ns, to_ns))
    warmed = _compute_share(until_s, _CHIP_LAG_S) - _compute_share(since_s, _CHIP_LAG_S)
    return _CHIP_K * max(warmed, _compute_share(off_s, _CHIP_LAG_S))


def _get_step_K(seen: _ChannelState) -> float:
    """The step of its display, K; 0 while it is not known; one coarser than 2 K does not widen anything further."""
    return 0.0 if math.isinf(seen.step_K) else min(seen.step_K, 2.0)


def _measure_beyond_K(seen: _ChannelState, value: float, time_ns: int) -> float:
    """Return how far a reading is outside of what lies between the last one and where the trend leads, K."""
    ahead_K, (least_s, most_s) = 0.0, _TREND_S
    spans = [each for each in seen.recent if least_s <= (seen.time_ns - each[0]) / NS_PER_S <= most_s]
    if spans:
        rate_K_ns = (seen.value - spans[0][1]) / (seen.time_ns - spans[0][0])
        ahead_K = max(-_TREND_K, min(_TREND_K, rate_K_ns * (time_ns - seen.time_ns)))
    low, high = sorted((seen.value, seen.value + ahead_K))
    return max(value - high, 0.0) - max(low - value, 0.0)


def _record_value(seen: _ChannelState, value: float, time_ns: int, *, is_poll: bool) -> None:
    step_K = abs(value - seen.value)
    if step_K > _SAME_K:
        seen.step_K = min(seen.step_K, step_K)
    if not abs(value - seen.still_degC) <= _REST_K + _get_step_K(seen):  # at first it is NaN
        seen.still_degC, seen.still_ns = value, time_ns
    seen.value, seen.time_ns = value, time_ns
    seen.recent.append((time_ns, value))
    while (time_ns - seen.recent[0][0]) / NS_PER_S > _WINDOW_S:
        seen.recent.popleft()
    if is_poll:
        seen.polled.append(value)
