"""The guard's table: which rules, how long each must object, and what is then done."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

from thermostand.drivers.devices.regulators.software_regulator import SoftwareRegulatorSettings
from thermostand.experiments.steps import Capture
from thermostand.foundation.events import FRAMES_RESUMED, FRAMES_STOPPED
from thermostand.foundation.items import Event, Item, StepMark, StepState
from thermostand.stand.config.added_rules import added_rule
from thermostand.stand.config.dew import dew_point_degC
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.fault import DONE, Readings, Rule, Watch, value_of
from thermostand.stand.gate import HELD, OPERATOR, RELEASED
from thermostand.stand.guarding.channel_limits import limit_watches
from thermostand.stand.guarding.channels import LEAST_LAG_S, Nature
from thermostand.stand.guarding.drifting import drifting
from thermostand.stand.guarding.heat_balance import heat_not_felt, too_much_heat
from thermostand.stand.guarding.interlocks import (
    Recording,
    camera_temperature_bad,
    contact,
    dewed,
    disagreement,
    flap_open,
    folder_lost,
    frames_stopped,
    not_recorded,
    over_temperature,
    paused,
    permit_missing,
    recording_ended,
    reported_fault,
    settings_changed,
    stage_alarm,
    stopped_while_permitted,
    trustworthy,
)
from thermostand.stand.guarding.plausibility import (
    FollowingBody,
    WarmAround,
    cooling_in_vain,
    measured,
    together,
    warming_while_off,
)
from thermostand.stand.guarding.startup_response import first_heat
from thermostand.stand.guarding.steady_state_power import output_not_as_needed
from thermostand.stand.guarding.stuck_sensor import frozen, stuck_while_other_moves
from thermostand.stand.guarding.suspects import Witnesses, telling
from thermostand.stand.guarding.thermal_crosscheck import camera_feels, granite_feels

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


def safety_thermometers(config: StandConfig) -> tuple[str, ...]:
    """Those with `role: safety`."""
    return tuple(f"thermometers.{name}" for name, each in config.sensors.items() if each.is_safety)


def granite(config: StandConfig) -> tuple[str, ...]:
    """The granite inside, where a thermometer measures it."""
    return (GRANITE,) if "granite_inside" in config.sensors else ()


def vital(config: StandConfig) -> tuple[str, ...]:
    """Without a fresh reading of each of these there is no heat."""
    return (PV, AIR, *granite(config), *safety_thermometers(config))


def watches(config: StandConfig, announced: Announcements) -> tuple[Watch, ...]:
    """Every rule with the configured limits. Abort where the stand's temperature is not known or not controlled: that
    ends a night. Hold where an operator can put it right and the night is worth continuing."""
    seen = witnesses(config)
    return (
        *_temperatures(config),
        *_heat(config, seen),
        *_sensors(config, seen),
        *_drifts(config),
        *_independent(config, seen),
        *_operations(config, announced),
        *_contacts(config),
        *_dew(config),
        *limit_watches(config.guard.channels),
        *(watch for name, each in config.guard.added.items() for watch in added_rule(name).watches(each, config)),
    )


def _temperatures(config: StandConfig) -> tuple[Watch, ...]:
    """What must never be, at once. The camera's own temperature is limited but not required: it is off before a
    warm-up."""
    limits = config.guard
    return (
        Watch(over_temperature(PV, limits.max_air_degC)),
        *(Watch(over_temperature(channel, limits.max_air_degC)) for channel in (AIR, *safety_thermometers(config))),
        *(Watch(over_temperature(channel, limits.max_granite_degC)) for channel in granite(config)),
        *(
            Watch(over_temperature(f"{name}.temperature", limits.max_camera_degC, cuts_camera=True))
            for name in config.cameras
        ),
        *(
            Watch(trustworthy(channel, limits.stale_after_s), after_gap_s=limits.stale_after_s)
            for channel in vital(config)
        ),
    )


def _heat(config: StandConfig, seen: Witnesses) -> tuple[Watch, ...]:
    """Heat that does not come, comes unasked, or is held back. The first may be a detached sensor, the second is out
    of control; a relay that does not close or answer, or a compressor that does not cool, can be put right."""
    limits = config.guard
    return (
        Watch(
            telling(
                warming_while_off(limits.heater_off, AIR, "regulator", PERMIT, _surroundings(config)),
                (AIR, PV),
                seen,
                compares=False,
            )
        ),
        Watch(cooling_in_vain(limits.cooling, AIR, "regulator", COMPRESSOR, _surroundings(config)), action="hold"),
        # The unit and this program may differ for panel_change_grace_s: somebody may press a key at its panel.
        Watch(permit_missing(RUNNING, PERMIT), 2 * limits.panel_change_grace_s, "hold"),
        Watch(trustworthy(PERMIT, limits.panel_change_grace_s), limits.panel_change_grace_s, "hold"),
    )


def witnesses(config: StandConfig) -> Witnesses:
    """What shows which of two channels moved unlike the rest."""
    chamber = config.chamber
    bodies = dict.fromkeys(granite(config), chamber.granite_lag_s)
    cameras = {f"{name}.temperature": chamber.camera_lag_s for name in config.cameras}
    in_air = (*((PV,) if _has_probe(config) else ()), AIR, *safety_thermometers(config))
    return Witnesses(in_air, bodies | cameras, chamber, ("regulator", PERMIT), (FLAP,), (SET_POINT, COMPRESSOR))


def _has_probe(config: StandConfig) -> bool:
    """A regulator of our own has none: it shows what its thermometer does."""
    return not isinstance(config.regulator, SoftwareRegulatorSettings)


def _sensors(config: StandConfig, seen: Witnesses) -> tuple[Watch, ...]:
    """Of two sensors that disagree each may be wrong: the others say which."""
    limits = config.guard.sensors

    def apart(channel: str, most_K: float) -> Rule:
        return telling(disagreement(channel, AIR, most_K), (channel, AIR), seen)

    stays = stuck_while_other_moves(PV, AIR)
    return (
        Watch(apart(PV, limits.warn_K), limits.warn_after_s, "warn"),
        Watch(apart(PV, limits.trip_K), limits.trip_after_s),
        # Where a safety thermometer sits is the laboratory's choice, but one that reads low guards nothing.
        *(Watch(apart(each, limits.warn_K), limits.warn_after_s, "warn") for each in safety_thermometers(config)),
        Watch(telling(stays, (PV, AIR), seen), action="hold"),
    )


def _drifts(config: StandConfig) -> tuple[Watch, ...]:
    """The air's thermometer against others in that air: `safety` ones, and the regulator's probe, which shows 0.1 K and
    sits beside the heater, where it has one. Gradients in the air are others while the regulator is stopped, and while
    the compressor runs against the heater: those are states of their own."""
    same, limit_K = (FLAP, "relays.camera_power", RUNNING, COMPRESSOR), config.guard.sensors.drift_K
    others = dict.fromkeys(safety_thermometers(config), limit_K)
    if config.regulator_unit is not None:
        others[PV] = limit_K + _PV_K
    return tuple(
        Watch(
            drifting((AIR, other), SET_POINT, same, most_K, [each for each in others if each != other]), action="warn"
        )
        for other, most_K in others.items()
    )


def _independent(config: StandConfig, seen: Witnesses) -> tuple[Watch, ...]:
    """Looks that hold when both probes are wrong alike: heat that was given, and what else stands in that air. Abort,
    for its temperature is unknown; but a thermometer that is frozen, and a first heat that arrives elsewhere, are
    found before anything is warm. The camera's own temperature is not required: one that is stale is a warning."""
    limits, chamber = config.guard, config.chamber
    feels, warms = limits.granite_crosscheck, limits.camera_crosscheck
    module = tuple(f"thermometers.{name}" for name in config.sensors)
    return (
        Watch(too_much_heat(limits.heat_max_Wh_per_h, chamber.heater_W, "regulator", PERMIT)),
        *(Watch(heat_not_felt(limits.heat_balance, chamber, probe, "regulator", PERMIT)) for probe in (PV, AIR)),
        *(
            Watch(telling(granite_feels(feels, chamber.granite_lag_s, body, probe), (body, probe), seen))
            for body in granite(config)
            for probe in (PV, AIR)
        ),
        *(
            Watch(telling(camera_feels(warms, chamber.camera_lag_s, body, probe), (body, probe), seen))
            for body in (f"{name}.temperature" for name in config.cameras)
            for probe in (AIR, PV)
        ),
        Watch(output_not_as_needed(limits.steady_state_power, "regulator", PERMIT, COMPRESSOR, FLAP)),
        *(Watch(frozen(channel, module, "regulator"), action="hold") for channel in (AIR, *granite(config))),
        Watch(first_heat(limits.startup_response, AIR, "regulator", PERMIT), action="hold"),
    )


def _surroundings(config: StandConfig) -> WarmAround:
    """What could warm the air."""
    found = measured(*((LABORATORY,) if "laboratory" in config.sensors else ()), *granite(config))
    if granite(config):
        return found
    return together(found, FollowingBody(AIR, config.chamber.granite_lag_s, config.limits.chamber_degC[1]))


def natures(config: StandConfig) -> dict[str, Nature]:
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
        **({PV: Nature((low_degC - _OUTSIDE_K, high_degC + _OUTSIDE_K), follows=AIR)} if has_probe else {}),
        **{
            f"thermometers.{name}": Nature(each.plausible_degC, lags_s.get(name, LEAST_LAG_S), followed.get(name, ""))
            for name, each in config.sensors.items()
        },
        **{f"{name}.temperature": Nature(each.calibration.plausible_degC) for name, each in config.probes.items()},
        **{
            f"{name}.temperature": Nature(
                _CAMERA_DEGC, chamber.camera_lag_s, AIR, each.self_heating_K or (0.0, math.inf)
            )
            for name, each in config.cameras.items()
            if each.has_temperature
        },
    }


def _operations(config: StandConfig, announced: Announcements) -> tuple[Watch, ...]:
    """Hands on the regulator's keys, a stage's alarm, a flap that is open or cannot be asked, a full disk: an operator
    has to come.

    A flap that stays open is closed by making safe; when it does not close, that is an error event of its own.
    """
    limits = config.guard
    return (
        Watch(reported_fault("regulator.fault"), limits.panel_change_grace_s, "hold"),
        Watch(stopped_while_permitted(RUNNING, PERMIT), limits.panel_change_grace_s, "hold"),
        *(Watch(stage_alarm(f"{name}.position"), action="hold") for name in config.axes),
        *(Watch(settings_changed(f"{name}.homed"), action="warn") for name in config.axes),
        *(_flap_watches(config, announced) if config.flap is not None else ()),
        Watch(frames_stopped(lambda: announced.frames_stopped), limits.disk_low_s, "hold"),
        Watch(paused(lambda: announced.is_paused), 3600.0 * limits.pause_limit_h, "hold"),
    )


def _flap_watches(config: StandConfig, announced: Announcements) -> tuple[Watch, ...]:
    limits = config.guard
    return (
        Watch(flap_open(FLAP, lambda: announced.is_capturing), limits.flap_open_s, "hold"),
        Watch(flap_open(FLAP), limits.flap_capture_s, "hold"),
        Watch(trustworthy(FLAP, limits.flap_open_s / 2), limits.flap_open_s / 2, "hold"),
    )


def cold_parts(config: StandConfig) -> tuple[str, ...]:
    """What water would settle on first, as far as it is measured: the target, or the granite it stands on, and the
    cameras."""
    target = ("thermometers.artifact",) if "artifact" in config.sensors else granite(config)
    return (*target, *(f"{name}.temperature" for name in config.cameras))


def _dew(config: StandConfig) -> tuple[Watch, ...]:
    """Water on lens or target ends a night's work without a sign; making safe closes the flap."""
    dew = config.dew
    if dew is None:
        return ()
    return (Watch(dewed(FLAP, cold_parts(config), partial(dew_limit_degC, config)), dew.flap_s, "hold"),)


def dew_limit_degC(config: StandConfig, readings: Readings) -> float:
    """What nothing may be below that meets the laboratory's air; NaN while that is unknown, or on a stand that is not
    asked to look."""
    if config.dew is None:
        return math.nan
    probe, measured_degC = config.dew.hygrometer, math.nan
    if probe is not None:
        humidity_percent = value_of(readings, f"{probe}.humidity")
        if humidity_percent > 0:
            measured_degC = dew_point_degC(value_of(readings, f"{probe}.temperature"), humidity_percent)
    return config.dew.lowest_degC(value_of(readings, LABORATORY), measured_degC)


def _contacts(config: StandConfig) -> tuple[Watch, ...]:
    """Door, emergency stop and whatever else the stand's file names. One that cannot be read for as long as any other
    reading may be old counts as one that says so, but ends no run: whether it is a fault nobody knows."""
    watches: list[Watch] = []
    for name, each in ({} if config.inputs is None else config.inputs.contacts).items():
        channel = f"inputs.{name}"
        text = f"{channel} is {each.fault_when}{f': {each.means}' if each.means else ''}"
        watches.append(
            Watch(contact(channel, float(each.fault_when == "closed"), text), each.after_s, DONE[each.action])
        )
        stale = "warn" if each.action == "warn" else "hold"
        limit_s = config.guard.stale_after_s
        watches.append(Watch(trustworthy(channel, limit_s), action=stale, after_gap_s=limit_s))
    return tuple(watches)


def recorded(config: StandConfig, recording: Recording) -> tuple[Watch, ...]:
    """Heat only while it is recorded. A disk that hangs or refuses may work again by itself; a folder that was moved
    does not come back by itself. A run whose writer was killed is ended, and resumed by itself (writer_restarts.py)."""
    return (
        Watch(recording_ended(recording)),
        Watch(folder_lost(recording), action="hold"),
        Watch(
            not_recorded(recording, config.recording.durable_within_s),
            action="hold",
            ends_itself=True,
            after_gap_s=_CATCH_UP_S,
        ),
    )


def camera_measured(config: StandConfig, frames_to_come: Callable[[], bool]) -> tuple[Watch, ...]:
    """The paper's T is the camera's own temperature; none is asked of a camera that is configured to have none."""
    return tuple(
        Watch(
            camera_temperature_bad(f"{name}.temperature", frames_to_come),
            config.guard.camera_temperature_s,
            "hold",
            ends_itself=True,
        )
        for name, camera in config.cameras.items()
        if camera.has_temperature
    )
