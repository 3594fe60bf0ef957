"""The guard's table: which rules, how long each must object, and what is then done."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from thermostand.drivers.devices.regulators.software_regulator import SoftwareRegulatorSettings
from thermostand.drivers.devices.ups import UpsSettings
from thermostand.experiments.steps import Capture
from thermostand.foundation.clock import NS_PER_S, to_ns
from thermostand.foundation.events import CONNECTED, FRAMES_RESUMED, FRAMES_STOPPED, SENSOR, guard_rule
from thermostand.foundation.items import Event, Item, StepMark, StepState
from thermostand.stand.config.chamber_section import StartupResponseConfig, SteadyStatePowerConfig
from thermostand.stand.config.dew import compute_dew_point_degC
from thermostand.stand.config.guard_rule_plugins import load_rule
from thermostand.stand.config.guard_section import ChannelLimits
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.guarding.channel_check import LEAST_LAG_S, ChannelModel
from thermostand.stand.guarding.heat_balance import compute_heat_percent, limit_heat_energy, require_heat_response
from thermostand.stand.guarding.interlocks import (
    Recording,
    forbid_changed_settings,
    forbid_device_fault,
    forbid_dew,
    forbid_open_flap,
    forbid_stage_alarm,
    limit_disagreement,
    limit_pause,
    limit_temperature,
    require_camera_temperature,
    require_contact_state,
    require_durable_recording,
    require_frame_recording,
    require_fresh_reading,
    require_permit_relay,
    require_recording_process,
    require_regulator_running,
    require_session_folder,
)
from thermostand.stand.guarding.mains import watch_mains
from thermostand.stand.guarding.plausibility import (
    FollowingBody,
    WarmAround,
    combine_surroundings,
    forbid_warming_while_off,
    make_stateful_rule,
    read_channels,
    require_cooling_response,
)
from thermostand.stand.guarding.sensor_diagnosis import SensorHistory, Suspicion, name_suspect
from thermostand.stand.guarding.stuck_sensor import forbid_stuck_sensor, forbid_stuck_while_other_moves
from thermostand.stand.guarding.thermal_crosscheck import crosscheck_by_camera, crosscheck_by_granite
from thermostand.stand.safety.fault import DONE, Fault, Readings, Rule, Watch, get_value
from thermostand.stand.safety.gate import HELD, OPERATOR, RELEASED

# The output that a chamber at rest needs at its set-point, learned during the run: far from it, something is wrong.

OUTPUT_NOT_AS_NEEDED = guard_rule(
    "output_not_as_needed", "the regulator needs another output than before for the same set-point"
)
_FLAP_OPEN_ABOVE = 0.05  # as in interlocks.py
_BAND_K, _POWER_MEAN_S = 2.0, 300.0  # at its set-point; the cycles of a relay's output are a minute
# In proportion, set-points twice as far apart differ by 20 %, close to the limit of 25.
_POWER_NEAR_K = 3.0  # a set-point so near needs the same within 10 % in good sessions
_LEARNING = 0.25  # share of a new mean; the first is taken whole


@dataclass(frozen=True, slots=True)
class RestState:
    """What the chamber rests at."""

    set_point_degC: float
    compressor: float


@dataclass(frozen=True, slots=True)
class PowerState:
    """A state at rest since `since_ns`, the output summed over `count` looks since `begun_ns`; what was learned, %."""

    rest: RestState | None = None
    since_ns: int = 0
    begun_ns: int = 0
    sum_percent: float = 0.0
    count: int = 0
    learned: Mapping[RestState, float] = field(default_factory=dict[RestState, float])


def find_nearest(learned: Mapping[RestState, float], rest: RestState) -> float | None:
    """Return what was needed at the nearest set-point with the compressor alike; None where nothing near was
    learned."""
    found = [
        (abs(other.set_point_degC - rest.set_point_degC), percent)
        for other, percent in learned.items()
        if other.compressor == rest.compressor and abs(other.set_point_degC - rest.set_point_degC) <= _POWER_NEAR_K
    ]
    return min(found)[1] if found else None


def limit_output_deviation(
    limits: SteadyStatePowerConfig, regulator: str, permit: str, compressor: str, flap: str
) -> Rule:
    """The chamber needs far more, or far less, than it did at about this set-point: a probe that shows too little, or
    holds still, makes the regulator heat on."""

    def rest_of(readings: Readings) -> RestState | None:
        set_point_degC = get_value(readings, f"{regulator}.sp")
        off_K = abs(get_value(readings, f"{regulator}.pv") - set_point_degC)
        is_controlled = get_value(readings, f"{regulator}.running") == 1 and get_value(readings, permit) == 1
        is_open = get_value(readings, flap) > _FLAP_OPEN_ABOVE
        if not (is_controlled and off_K <= _BAND_K) or is_open:
            return None
        on = get_value(readings, compressor)
        return None if math.isnan(on) else RestState(set_point_degC, on)

    def step(last: PowerState | None, readings: Readings, now_ns: int) -> tuple[PowerState | None, Fault | None]:
        last = last or PowerState()
        rest = rest_of(readings)
        if rest is None or rest != last.rest:
            return PowerState(rest, since_ns=now_ns, learned=last.learned), None
        if now_ns - last.since_ns < to_ns(limits.settle_s):
            return last, None
        if last.count == 0:
            last = replace(last, begun_ns=now_ns)
        summed = replace(
            last, sum_percent=last.sum_percent + compute_heat_percent(readings, regulator, permit), count=last.count + 1
        )
        if now_ns - summed.begun_ns < to_ns(_POWER_MEAN_S):
            return summed, None
        return _judge_mean(summed, rest, limits, regulator)

    return make_stateful_rule(step)


def _judge_mean(
    needs: PowerState, rest: RestState, limits: SteadyStatePowerConfig, regulator: str
) -> tuple[PowerState, Fault | None]:
    mean_percent = needs.sum_percent / needs.count
    needed_percent = find_nearest(needs.learned, rest)
    state = replace(needs, sum_percent=0.0, count=0)
    if needed_percent is not None and abs(mean_percent - needed_percent) > limits.limit_percent:
        text = f"{regulator} heats by {mean_percent:.0f} % at {rest.set_point_degC:.1f} degC, where the chamber needed"
        return state, Fault(OUTPUT_NOT_AS_NEEDED, f"{text} {needed_percent:.0f} % before")
    was_percent = needs.learned.get(rest)
    now_percent = mean_percent if was_percent is None else was_percent + _LEARNING * (mean_percent - was_percent)
    return replace(state, learned={**needs.learned, rest: now_percent}), None


# Two thermometers in the same air, compared with themselves: a slow drift of one shows when a set-point is held again,
# or for long, long before it is large enough to be a disagreement.

SENSOR_DRIFTS = guard_rule("sensor_drifts", "two sensors of the same air drift apart while it is at rest", SENSOR)
_NEAR_K = 1.0  # of the set-point, or it is not held
_STILL_AFTER_S, _MEAN_S = 3600.0, 600.0  # walls have followed by then; over which a mean is taken

Key = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class _HeldSetPoint:
    """The set-point and what else is as it was, since when; the sums over the readings of the means under way, of
    channel minus other and minus each third; what each such state had at first (K, ns), and what is to be reported."""

    key: Key
    since_ns: int
    sums_K: tuple[float, ...] = ()
    count: int = 0
    first: Mapping[Key, tuple[tuple[float, ...], int]] = field(default_factory=dict[Key, tuple[tuple[float, ...], int]])
    fault: Fault | None = None


def limit_sensor_drift(
    pair: tuple[str, str], set_point: str, same: Sequence[str], limit_K: float, thirds: Sequence[str] = ()
) -> Rule:
    """The difference of both, held at a set-point, has changed by more than `limit_K` since that was first held, with
    the channels `same` (0 or 1: flap, supplies) as they were. thirds: others in that air, which show who of both it
    is."""
    channel, other = pair

    def step(last: _HeldSetPoint | None, readings: Readings, now_ns: int) -> tuple[_HeldSetPoint | None, Fault | None]:
        sp_degC, value_degC = get_value(readings, set_point), get_value(readings, channel)
        difference_K = value_degC - get_value(readings, other)
        key = (round(sp_degC, 1), *(float(get_value(readings, each) > 0.5) for each in same))
        if math.isnan(difference_K) or not abs(value_degC - sp_degC) < _NEAR_K or last is None or key != last.key:
            known = {} if last is None else last.first
            return _HeldSetPoint(key, now_ns, first=known, fault=last and last.fault), last and last.fault
        held_s = (now_ns - last.since_ns) / NS_PER_S
        if held_s < _STILL_AFTER_S:
            return last, last.fault
        apart_K = (difference_K, *(value_degC - get_value(readings, third) for third in thirds))
        sums_K = last.sums_K or (0.0,) * len(apart_K)
        held = replace(last, sums_K=tuple(a + b for a, b in zip(sums_K, apart_K, strict=True)), count=last.count + 1)
        if held_s >= _STILL_AFTER_S + _MEAN_S:
            held = _compared(held, now_ns)
        return held, held.fault

    def _compared(held: _HeldSetPoint, now_ns: int) -> _HeldSetPoint:
        means_K = tuple(sum_K / held.count for sum_K in held.sums_K)
        first_K, first_ns = held.first.get(held.key, (means_K, now_ns))
        known = {**held.first, held.key: (first_K, first_ns)}
        hours, changes_K = (now_ns - first_ns) / NS_PER_S / 3600, [b - a for a, b in zip(first_K, means_K, strict=True)]
        fault = None
        if abs(changes_K[0]) > limit_K:
            text = (
                f"{channel} minus {other} at {held.key[0]:g} degC has changed by {1e3 * changes_K[0]:+.0f} mK in "
                f"{hours:.1f} h ({1e3 * changes_K[0] / hours:+.1f} mK/h)"
            )
            found = _suspicion(changes_K)
            fault = Fault(SENSOR_DRIFTS, text + found.words(pair), channels=pair, suspect=found.suspect)
        return _HeldSetPoint(held.key, now_ns - to_ns(_STILL_AFTER_S), first=known, fault=fault)

    def _suspicion(changes_K: Sequence[float]) -> Suspicion:
        """Judge by the thirds, each of which has to be nearer to one of both by twice."""
        of_channel, of_other = list[str](), list[str]()
        for third, from_channel_K in zip(thirds, changes_K[1:], strict=True):
            from_other_K = from_channel_K - changes_K[0]
            if abs(from_channel_K) > 2 * abs(from_other_K):
                of_channel.append(third)
            elif abs(from_other_K) > 2 * abs(from_channel_K):
                of_other.append(third)
        if len(of_channel) == len(of_other):
            return Suspicion()
        is_channel = len(of_channel) > len(of_other)
        return Suspicion(channel if is_channel else other, tuple(of_channel if is_channel else of_other))

    return make_stateful_rule(step)


# The first heat of a daemon: do the regulator's probe, its heater and the chamber's air belong together?

FIRST_HEAT = guard_rule("first_heat", "the temperature does not rise where the first heat is given")
_HEATS_PERCENT = 40.0  # that no chamber can take without getting warmer
_LACKING_K = 1.0  # below its set-point by more than this the regulator heats, nearer it only holds


@dataclass(frozen=True, slots=True)
class StartupState:
    """Heating since `since_ns`, from what `shown_degC` (PV, air) were; the most that each has risen. is_passed: both
    have risen, and nothing is looked at any more."""

    since_ns: int
    shown_degC: tuple[float, float]
    risen_K: tuple[float, float] = (0.0, 0.0)
    sum_percent: float = 0.0
    count: int = 0
    is_passed: bool = False


def require_startup_response(limits: StartupResponseConfig, air: str, regulator: str, permit: str) -> Rule:
    """The regulator heats for the first time, and its value or the chamber's air does not rise: two identical
    regulators with exchanged addresses pass every other probe."""
    pv = f"{regulator}.pv"

    def begins(readings: Readings) -> bool:
        lacking_K = get_value(readings, f"{regulator}.sp") - get_value(readings, pv)
        return lacking_K > _LACKING_K and compute_heat_percent(readings, regulator, permit) >= _HEATS_PERCENT

    def step(last: StartupState | None, readings: Readings, now_ns: int) -> tuple[StartupState | None, Fault | None]:
        if last is not None and last.is_passed:
            return last, None
        shown_degC = get_value(readings, pv), get_value(readings, air)
        if math.isnan(sum(shown_degC)):
            return None, None
        if last is None:
            return (StartupState(now_ns, shown_degC) if begins(readings) else None), None
        return _judged(
            _update_state(last, shown_degC, compute_heat_percent(readings, regulator, permit)), readings, now_ns
        )

    def _judged(state: StartupState, readings: Readings, now_ns: int) -> tuple[StartupState | None, Fault | None]:
        if min(state.risen_K) >= limits.rise_K:
            return replace(state, is_passed=True), None
        if now_ns - state.since_ns < to_ns(limits.within_s):
            return state, None
        if state.sum_percent / state.count < _HEATS_PERCENT:
            return None, None  # too little heat to judge
        rises = " and ".join(
            f"{name} rose by {risen_K:.1f} K" for name, risen_K in zip((pv, air), state.risen_K, strict=True)
        )
        text = f"in the first {limits.within_s:g} s of heat {rises}; both should rise by {limits.rise_K:g} K"
        return None, Fault(FIRST_HEAT, f"{text}: is this regulator the one of this chamber?")

    return make_stateful_rule(step)


def _update_state(state: StartupState, shown_degC: tuple[float, float], percent: float) -> StartupState:
    risen_K = tuple(
        max(most_K, shown - begun)
        for most_K, shown, begun in zip(state.risen_K, shown_degC, state.shown_degC, strict=True)
    )
    return replace(
        state, risen_K=(risen_K[0], risen_K[1]), sum_percent=state.sum_percent + percent, count=state.count + 1
    )


# Limits of one's own for what any device of the stand measures (`guard.channels`).

CHANNEL_LIMIT = guard_rule(
    "channel_limit",
    "a channel is outside the limits that `guard.channels` sets for it",
    "see to what it measures; its limits are in the stand's file below `guard.channels`",
)
CHANNEL_SILENT = guard_rule("channel_silent", "a channel with limits in `guard.channels` has no reading", CONNECTED)


def limit_watches(limited: Mapping[str, ChannelLimits]) -> Iterator[Watch]:
    """Return what is looked at for the limits of these channels. Without a reading nobody knows whether a limit is
    kept: that waits for an operator, but it does not end a run."""
    for channel, limits in limited.items():
        yield Watch(_outside(channel, limits), limits.after_s, DONE[limits.action])
        yield Watch(
            _silent(channel, limits.after_s),
            action="warn" if limits.action == "warn" else "hold",
            after_gap_s=limits.after_s,
        )


def _outside(channel: str, limits: ChannelLimits) -> Rule:
    """The last value of `channel` is outside its limits. One that has no value is the matter of `_silent`."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        reading = readings.known(channel)
        if reading is None:
            return None
        unit = "" if reading.unit in ("", "1") else f" {reading.unit}"
        shown = f"{channel} is {reading.value:.6g}{unit}"
        if limits.lowest is not None and reading.value < limits.lowest:
            return Fault(CHANNEL_LIMIT, f"{shown}, below its limit of {limits.lowest:g}{unit}")
        if limits.highest is not None and reading.value > limits.highest:
            return Fault(CHANNEL_LIMIT, f"{shown}, above its limit of {limits.highest:g}{unit}")
        return None

    return rule


def _silent(channel: str, after_s: float) -> Rule:
    """`channel` has had no measurement for longer than `after_s`, since the guard began to look at the earliest."""
    begun_ns: int | None = None

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        nonlocal begun_ns
        begun_ns = now_ns if begun_ns is None else begun_ns
        good_ns, latest = readings.last_good_ns(channel), readings.latest(channel)
        silent_ns = now_ns - max(begun_ns, good_ns or 0)
        if silent_ns <= to_ns(after_s):
            return None
        why = "it has never been read" if latest is None else latest.reason or "it is not read any more"
        return Fault(CHANNEL_SILENT, f"{channel} has no reading for {silent_ns / NS_PER_S:.0f} s: {why}")

    return rule


PV, AIR, GRANITE, LABORATORY = (
    "regulator.pv",
    "thermometers.air",
    "thermometers.granite_inside",
    "thermometers.laboratory",
)
RUNNING, PERMIT, COMPRESSOR = "regulator.running", "relays.heater_enable", "relays.compressor"
FLAP, SET_POINT = "flap.position", "regulator.sp"
_PV_K = 0.1  # that a regulator shows
_OUTSIDE_K = 40.0  # beyond the set-points no regulator's probe can be
_CAMERA_DEGC = (-40.0, 120.0)  # as its driver takes them
_CATCH_UP_S = 10.0  # that a disk needs for what was published while the process was stopped


class Announcements:
    """What rules need from the hub besides readings: subscribe `receive`.

    is_capturing: a capture has begun and not ended. frames_stopped: why the recorder takes no frames, "" while it does.
    is_paused: an operator has paused the run, or has not answered a prompt.
    """

    def __init__(self) -> None:
        self.is_capturing = False
        self.frames_stopped = ""
        self.is_paused = False

    def forget(self) -> None:
        """The run that announced it is over."""
        self.is_capturing, self.frames_stopped, self.is_paused = False, "", False

    def receive(self, item: Item) -> None:
        """The hub's subscriber."""
        if isinstance(item, StepMark) and item.kind == Capture.kind:
            self.is_capturing = item.state is StepState.STARTED
        elif isinstance(item, Event) and item.kind in (FRAMES_STOPPED, FRAMES_RESUMED):
            self.frames_stopped = item.text if item.kind == FRAMES_STOPPED else ""
        elif isinstance(item, Event) and item.kind in (HELD, RELEASED) and item.data.get("reason") == OPERATOR:
            self.is_paused = item.kind == HELD


def list_safety_thermometers(config: StandConfig) -> tuple[str, ...]:
    """List the thermometers with `role: safety`."""
    return tuple(f"thermometers.{name}" for name, each in config.sensors.items() if each.is_safety)


def list_granite_channels(config: StandConfig) -> tuple[str, ...]:
    """The granite inside, where a thermometer measures it."""
    return (GRANITE,) if "granite_inside" in config.sensors else ()


def list_vital_channels(config: StandConfig) -> tuple[str, ...]:
    """List the channels without whose fresh readings there is no heat."""
    return (PV, AIR, *list_granite_channels(config), *list_safety_thermometers(config))


def make_watches(config: StandConfig, announced: Announcements) -> tuple[Watch, ...]:
    """Every rule with the configured limits. Abort where the stand's temperature is not known or not controlled: that
    ends the run. Hold where an operator can put it right and the run can then continue."""
    seen = make_sensor_history(config)
    return (
        *_watch_temperatures(config),
        *_watch_heat(config, seen),
        *_watch_sensors(config, seen),
        *_watch_drifts(config),
        *_watch_independent_evidence(config, seen),
        *_watch_operations(config, announced),
        *_watch_contacts(config),
        *_watch_dew(config),
        *(
            watch
            for name, each in config.devices.items()
            if isinstance(each, UpsSettings)
            for watch in watch_mains(name, each)
        ),
        *limit_watches(config.guard.channels),
        *(watch for name, each in config.guard.added.items() for watch in load_rule(name).watches(each, config)),
    )


def _watch_temperatures(config: StandConfig) -> tuple[Watch, ...]:
    """Return what must never be, at once. The camera's own temperature is limited but not required: it is off before a
    warm-up."""
    limits = config.guard
    return (
        Watch(limit_temperature(PV, limits.max_air_degC)),
        *(
            Watch(limit_temperature(channel, limits.max_air_degC))
            for channel in (AIR, *list_safety_thermometers(config))
        ),
        *(Watch(limit_temperature(channel, limits.max_granite_degC)) for channel in list_granite_channels(config)),
        *(
            Watch(limit_temperature(f"{name}.temperature", limits.max_camera_degC, cuts_camera=True))
            for name in config.cameras
        ),
        *(
            Watch(require_fresh_reading(channel, limits.stale_after_s), after_gap_s=limits.stale_after_s)
            for channel in list_vital_channels(config)
        ),
    )


def _watch_heat(config: StandConfig, seen: SensorHistory) -> tuple[Watch, ...]:
    """Make the rules about heat that does not come, comes unasked, or is held back. The first may be a detached sensor,
    the second is out of control; a relay that does not close or answer, or a compressor that does not cool, can be put
    right."""
    limits = config.guard
    return (
        Watch(
            name_suspect(
                forbid_warming_while_off(limits.heater_off, AIR, "regulator", PERMIT, _make_surroundings(config)),
                (AIR, PV),
                seen,
                compares=False,
            )
        ),
        Watch(
            require_cooling_response(limits.cooling, AIR, "regulator", COMPRESSOR, _make_surroundings(config)),
            action="hold",
        ),
        # The unit and this program may differ for panel_change_grace_s: somebody may press a key at its panel.
        Watch(require_permit_relay(RUNNING, PERMIT), 2 * limits.panel_change_grace_s, "hold"),
        Watch(require_fresh_reading(PERMIT, limits.panel_change_grace_s), limits.panel_change_grace_s, "hold"),
    )


def make_sensor_history(config: StandConfig) -> SensorHistory:
    """Return what shows which of two channels moved unlike the rest."""
    chamber = config.chamber
    bodies = dict.fromkeys(list_granite_channels(config), chamber.granite_lag_s)
    cameras = {f"{name}.temperature": chamber.camera_lag_s for name in config.cameras}
    in_air = (*((PV,) if _has_probe(config) else ()), AIR, *list_safety_thermometers(config))
    return SensorHistory(in_air, bodies | cameras, chamber, ("regulator", PERMIT), (FLAP,), (SET_POINT, COMPRESSOR))


def _has_probe(config: StandConfig) -> bool:
    """A regulator of our own has none: it shows what its thermometer does."""
    return not isinstance(config.regulator, SoftwareRegulatorSettings)


def _watch_sensors(config: StandConfig, seen: SensorHistory) -> tuple[Watch, ...]:
    """Compare two sensors. Of two that disagree each may be wrong: the others show which."""
    limits = config.guard.sensors

    def apart(channel: str, most_K: float) -> Rule:
        return name_suspect(limit_disagreement(channel, AIR, most_K), (channel, AIR), seen)

    stays = forbid_stuck_while_other_moves(PV, AIR)
    return (
        Watch(apart(PV, limits.warn_K), limits.warn_after_s, "warn"),
        Watch(apart(PV, limits.trip_K), limits.trip_after_s),
        # Where a safety thermometer sits is the laboratory's choice, but one that reads low guards nothing.
        *(Watch(apart(each, limits.warn_K), limits.warn_after_s, "warn") for each in list_safety_thermometers(config)),
        Watch(name_suspect(stays, (PV, AIR), seen), action="hold"),
    )


def _watch_drifts(config: StandConfig) -> tuple[Watch, ...]:
    """The air's thermometer against others in that air: `safety` ones, and the regulator's probe, which shows 0.1 K and
    sits next to the heater, where it has one. Gradients in the air are others while the regulator is stopped, and while
    the compressor runs against the heater: those are states of their own."""
    same, limit_K = (FLAP, "relays.camera_power", RUNNING, COMPRESSOR), config.guard.sensors.drift_K
    others = dict.fromkeys(list_safety_thermometers(config), limit_K)
    if config.regulator_unit is not None:
        others[PV] = limit_K + _PV_K
    return tuple(
        Watch(
            limit_sensor_drift((AIR, other), SET_POINT, same, most_K, [each for each in others if each != other]),
            action="warn",
        )
        for other, most_K in others.items()
    )


def _watch_independent_evidence(config: StandConfig, seen: SensorHistory) -> tuple[Watch, ...]:
    """Looks that hold when both probes are wrong alike: heat that was given, and what else stands in that air. Abort,
    for its temperature is unknown; but a thermometer that is frozen, and a first heat that arrives elsewhere, are
    found before anything is warm. The camera's own temperature is not required: one that is stale is a warning."""
    limits, chamber = config.guard, config.chamber
    feels, warms = limits.granite_crosscheck, limits.camera_crosscheck
    module = tuple(f"thermometers.{name}" for name in config.sensors)
    return (
        Watch(limit_heat_energy(limits.heat_max_Wh_per_h, chamber.heater_W, "regulator", PERMIT)),
        *(
            Watch(require_heat_response(limits.heat_balance, chamber, probe, "regulator", PERMIT))
            for probe in (PV, AIR)
        ),
        *(
            Watch(name_suspect(crosscheck_by_granite(feels, chamber.granite_lag_s, body, probe), (body, probe), seen))
            for body in list_granite_channels(config)
            for probe in (PV, AIR)
        ),
        *(
            Watch(name_suspect(crosscheck_by_camera(warms, chamber.camera_lag_s, body, probe), (body, probe), seen))
            for body in (f"{name}.temperature" for name in config.cameras)
            for probe in (AIR, PV)
        ),
        Watch(limit_output_deviation(limits.steady_state_power, "regulator", PERMIT, COMPRESSOR, FLAP)),
        *(
            Watch(forbid_stuck_sensor(channel, module, "regulator"), action="hold")
            for channel in (AIR, *list_granite_channels(config))
        ),
        Watch(require_startup_response(limits.startup_response, AIR, "regulator", PERMIT), action="hold"),
    )


def _make_surroundings(config: StandConfig) -> WarmAround:
    """Return what could warm the air."""
    found = read_channels(*((LABORATORY,) if "laboratory" in config.sensors else ()), *list_granite_channels(config))
    if list_granite_channels(config):
        return found
    return combine_surroundings(found, FollowingBody(AIR, config.chamber.granite_lag_s, config.limits.chamber_degC[1]))


def make_channel_models(config: StandConfig) -> dict[str, ChannelModel]:
    """Every temperature that a model or a rule uses, and what is known of it beforehand. That of a regulator of our own
    is its thermometer's."""
    chamber, (low_degC, high_degC) = config.chamber, config.limits.chamber_degC
    has_probe = _has_probe(config)
    followed = {
        "air": PV if has_probe else "",
        "granite_inside": AIR,
        **{name: AIR for name, each in config.sensors.items() if each.is_safety},
    }
    lags_s = {"granite_inside": chamber.granite_lag_s, "granite_outside": chamber.granite_lag_s}
    return {
        **({PV: ChannelModel((low_degC - _OUTSIDE_K, high_degC + _OUTSIDE_K), follows=AIR)} if has_probe else {}),
        **{
            f"thermometers.{name}": ChannelModel(
                each.plausible_degC, lags_s.get(name, LEAST_LAG_S), followed.get(name, "")
            )
            for name, each in config.sensors.items()
        },
        **{
            f"{name}.temperature": ChannelModel(each.calibration.plausible_degC) for name, each in config.probes.items()
        },
        **{
            f"{name}.temperature": ChannelModel(
                _CAMERA_DEGC, chamber.camera_lag_s, AIR, each.self_heating_K or (0.0, math.inf)
            )
            for name, each in config.cameras.items()
            if each.has_temperature
        },
    }


def _watch_operations(config: StandConfig, announced: Announcements) -> tuple[Watch, ...]:
    """Hands on the regulator's keys, a stage's alarm, a flap that is open or cannot be asked, a full disk: an operator
    has to come.

    A flap that stays open is closed by making safe; when it does not close, that is an error event of its own.
    """
    limits = config.guard
    return (
        Watch(forbid_device_fault("regulator.fault"), limits.panel_change_grace_s, "hold"),
        Watch(require_regulator_running(RUNNING, PERMIT), limits.panel_change_grace_s, "hold"),
        *(Watch(forbid_stage_alarm(f"{name}.position"), action="hold") for name in config.axes),
        *(Watch(forbid_changed_settings(f"{name}.homed"), action="warn") for name in config.axes),
        *(_watch_flap(config, announced) if config.flap is not None else ()),
        Watch(require_frame_recording(lambda: announced.frames_stopped), limits.disk_low_s, "hold"),
        Watch(limit_pause(lambda: announced.is_paused), 3600.0 * limits.pause_limit_h, "hold"),
    )


def _watch_flap(config: StandConfig, announced: Announcements) -> tuple[Watch, ...]:
    limits = config.guard
    return (
        Watch(forbid_open_flap(FLAP, lambda: announced.is_capturing), limits.flap_open_s, "hold"),
        Watch(forbid_open_flap(FLAP), limits.flap_capture_s, "hold"),
        Watch(require_fresh_reading(FLAP, limits.flap_open_s / 2), limits.flap_open_s / 2, "hold"),
    )


def list_cold_parts(config: StandConfig) -> tuple[str, ...]:
    """Return what water would settle on first, as far as it is measured: the target, or the granite it stands on, and
    the cameras."""
    target = ("thermometers.artifact",) if "artifact" in config.sensors else list_granite_channels(config)
    return (*target, *(f"{name}.temperature" for name in config.cameras))


def _watch_dew(config: StandConfig) -> tuple[Watch, ...]:
    """Water on lens or target ends the work of a run without a sign; making safe closes the flap."""
    dew = config.dew
    if dew is None:
        return ()
    return (
        Watch(forbid_dew(FLAP, list_cold_parts(config), partial(compute_dew_limit_degC, config)), dew.flap_s, "hold"),
    )


def compute_dew_limit_degC(config: StandConfig, readings: Readings) -> float:
    """Return what nothing may be below that meets the laboratory's air; NaN while that is unknown, or on a stand that
    is not asked to look."""
    if config.dew is None:
        return math.nan
    probe, measured_degC = config.dew.hygrometer, math.nan
    if probe is not None:
        humidity_percent = get_value(readings, f"{probe}.humidity")
        if humidity_percent > 0:
            measured_degC = compute_dew_point_degC(get_value(readings, f"{probe}.temperature"), humidity_percent)
    return config.dew.lowest_degC(get_value(readings, LABORATORY), measured_degC)


def _watch_contacts(config: StandConfig) -> tuple[Watch, ...]:
    """Door, emergency stop and whatever else the stand's file names. One that cannot be read for as long as any other
    reading may be old counts as one that says so, but ends no run: whether it is a fault nobody knows."""
    watches: list[Watch] = []
    for name, each in ({} if config.inputs is None else config.inputs.contacts).items():
        channel = f"inputs.{name}"
        text = f"{channel} is {each.fault_when}{f': {each.means}' if each.means else ''}"
        watches.append(
            Watch(
                require_contact_state(channel, float(each.fault_when == "closed"), text),
                each.after_s,
                DONE[each.action],
            )
        )
        stale = "warn" if each.action == "warn" else "hold"
        limit_s = config.guard.stale_after_s
        watches.append(Watch(require_fresh_reading(channel, limit_s), action=stale, after_gap_s=limit_s))
    return tuple(watches)


def watch_recording(config: StandConfig, recording: Recording) -> tuple[Watch, ...]:
    """Make the rules by which heat is given only while it is recorded. A disk that hangs or refuses may work again by
    itself; a folder that was moved does not come back by itself. A run whose writer was killed is ended, and resumed by
    itself (writer_restarts.py)."""
    return (
        Watch(require_recording_process(recording)),
        Watch(require_session_folder(recording), action="hold"),
        Watch(
            require_durable_recording(recording, config.recording.durable_within_s),
            action="hold",
            ends_itself=True,
            after_gap_s=_CATCH_UP_S,
        ),
    )


def watch_camera_temperature(config: StandConfig, frames_to_come: Callable[[], bool]) -> tuple[Watch, ...]:
    """The paper's T is the camera's own temperature; none is asked of a camera that is configured to have none."""
    return tuple(
        Watch(
            require_camera_temperature(f"{name}.temperature", frames_to_come),
            config.guard.camera_temperature_s,
            "hold",
            ends_itself=True,
        )
        for name, camera in config.cameras.items()
        if camera.has_temperature
    )
