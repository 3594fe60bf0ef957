"""What can be broken in a simulated laboratory: one table, name -> how, with which value, and how it is mended.

A name begins with the device or the link. Every fault is set by a value, which is its `worst` unless another is given,
and undone by its `mended` one. A fault that cannot be undone (somebody pressed a key) just ends.
"""

from __future__ import annotations

import heapq
import itertools
import json
import re
import threading
from collections.abc import Callable, Iterable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from difflib import get_close_matches
from operator import attrgetter

from pydantic import TypeAdapter

from thermostand.drivers.sim.laboratory import Laboratory
from thermostand.drivers.sim.motion.flap import ERROR_FEEDBACK_DISCONNECT, ERROR_HARD_OVER_CURRENT, ERROR_NO_POWER
from thermostand.drivers.sim.motion.ximc import FakeAxis
from thermostand.drivers.sim.motion.ximc_table import FLAG_DRIVER_OVERHEAT, FLAG_WINDING_MISMATCH
from thermostand.drivers.sim.units.thermal_imager import SERIAL_NUMBER
from thermostand.drivers.sim.wire import LINK_FAULTS, set_link_fault
from thermostand.foundation.clock import to_ns
from thermostand.foundation.errors import ConfigError

Setter = Callable[[Laboratory, object], None]


@dataclass(frozen=True, slots=True)
class Breakage:
    """How something is broken: by a value, `worst` when none is given; the one that mends it; what it means. `locks`:
    set under the plant's lock; a wire that is unplugged waits for its thread, which may want that lock."""

    apply: Setter
    worst: object
    mended: object
    text: str
    locks: bool = True


def number(value: object) -> float:
    """A value as given, 0 for none."""
    return float(str(value or 0))


def number_or_none(value: object) -> float | None:
    """A value as given."""
    return None if value is None else float(str(value))


def make_setter(path: str, kind: Callable[[object], object] = bool) -> Setter:
    """Sets one attribute of one fake, by its path from the laboratory."""
    owner, _, attribute = path.rpartition(".")

    def apply(laboratory: Laboratory, value: object) -> None:
        setattr(attrgetter(owner)(laboratory) if owner else laboratory, attribute, kind(value))

    return apply


def make_number_call(path: str, worst: float, text: str) -> Breakage:
    """A number is given to a method of one fake, unless the value is none."""

    def apply(laboratory: Laboratory, value: object) -> None:
        if value is not None:
            attrgetter(path)(laboratory)(float(str(value)))

    return Breakage(apply, worst, None, text)


def make_amount(path: str, worst: float, text: str) -> Breakage:
    """One attribute of one fake is this number, 0 once it is mended."""
    return Breakage(make_setter(path, number), worst, 0.0, text)


def make_held_number(path: str, worst: float, text: str) -> Breakage:
    """One attribute of one fake is this number, None once it is mended."""
    return Breakage(make_setter(path, number_or_none), worst, None, text)


def make_whole_number(path: str, worst: int, mended: int, text: str) -> Breakage:
    """One attribute of one fake is this whole number."""
    return Breakage(make_setter(path, lambda value: int(number(value))), worst, mended, text)


def make_flag(path: str, text: str) -> Breakage:
    """One attribute of one fake is true."""
    return Breakage(make_setter(path), True, False, text)


def make_shown_word(path: str, word: str, text: str) -> Breakage:
    """One attribute of one fake is this word, None once it is mended."""
    return Breakage(make_setter(path, lambda value: word if value else None), True, False, text)


def make_held_word(path: str, worst: str, text: str) -> Breakage:
    """One attribute of one fake is the word that is given, None once it is mended."""
    return Breakage(make_setter(path, lambda value: None if value is None else str(value)), worst, None, text)


@dataclass(frozen=True, slots=True)
class Once:
    """Something that happens when the fault is set, and is not undone."""

    act: Callable[[Laboratory], None]

    def __call__(self, laboratory: Laboratory, value: object) -> None:
        """It happens, unless the value is none."""
        if value:
            self.act(laboratory)


def make_once(path: str, text: str) -> Breakage:
    """A method of one fake is called."""
    return Breakage(Once(lambda laboratory: attrgetter(path)(laboratory)()), True, False, text)


AXES = ("linear", "rotary")
_AIR = "air"
_ERRORS = {"feedback": ERROR_FEEDBACK_DISCONNECT, "power": ERROR_NO_POWER, "current": ERROR_HARD_OVER_CURRENT}


def list_known_faults(laboratory: Laboratory) -> dict[str, Breakage]:
    """FAULTS, and those of the lines and axes that this laboratory has."""
    return FAULTS | make_link_and_axis_faults(laboratory.links, laboratory.axes)


def inject(laboratory: Laboratory, name: str, value: object) -> None:
    """Set one of those known to it to `value`; KeyError, TypeError or ValueError when name or value is none."""
    fault = list_known_faults(laboratory)[name]
    with laboratory.plant.lock if fault.locks else nullcontext():
        fault.apply(laboratory, value)


def _numbers(laboratory: Laboratory, value: object) -> dict[int, float]:
    """`{"air": 30.0}` by channel numbers."""
    named = TypeAdapter(dict[str, float]).validate_python(value or {})
    return {_sensors(laboratory)[name]: number for name, number in named.items()}


def _channel(laboratory: Laboratory, value: object) -> set[int]:
    return {_sensors(laboratory)[str(value)]} if value else set()


def _sensors(laboratory: Laboratory) -> dict[str, int]:
    """The channels of the thermometers, by name."""
    return laboratory.spec.devices["thermometers"].settings["channels"]


def make_sensor_fault(
    attribute: str, kind: Callable[[Laboratory, object], object], worst: object, text: str
) -> Breakage:
    """One attribute of each module of thermometers."""

    def apply(laboratory: Laboratory, value: object) -> None:
        changed = kind(laboratory, value)
        for module in laboratory.thermometer_modules:
            setattr(module, attribute, changed)

    return Breakage(apply, worst, None, text)


def _exchange_probes(laboratory: Laboratory, value: object) -> None:
    laboratory.regulator.probe_exchanged = laboratory.thermometers.air_exchanged = bool(value)


def _press_manual(laboratory: Laboratory, value: object) -> None:
    if value is None:
        laboratory.regulator.press_automatic()
    else:
        laboratory.regulator.press_manual(float(str(value)))


def _clamp_set_point(laboratory: Laboratory, value: object) -> None:
    limits = None if value is None else TypeAdapter(tuple[float, float]).validate_python(value)
    laboratory.regulator.setpoint_clamp_degC = limits


def _silent_relays(laboratory: Laboratory, value: object) -> None:
    """The board does not answer for so many s of simulated time."""
    relays, plant = laboratory.relays, laboratory.plant
    until_ns = plant.now_ns + to_ns(number(value))
    relays.silent = plant.now_ns < until_ns

    def wait(time_ns: int, dt_s: float) -> None:
        relays.silent = relays.silent and time_ns < until_ns

    plant.on_step.append(wait)


def _change_contact(laboratory: Laboratory, value: object) -> None:
    if laboratory.inputs is not None:
        contacts = laboratory.spec.devices["inputs"].settings["contacts"]
        closed = {each["channel"] for each in contacts.values() if each["fault_when"] == "open"}
        laboratory.inputs.closed_inputs = closed ^ ({contacts[str(value)]["channel"]} if value else set[int]())


def _alarm_axis(laboratory: Laboratory, value: object) -> None:
    if value is not None and value not in laboratory.axes:
        raise ValueError(f"there is no axis {value}")
    for name, axis in laboratory.axes.items():
        axis.alarm = name == value


def _wrong_module(laboratory: Laboratory, value: object) -> None:
    laboratory.thermometers.type_codes = [0x22 if value else 0x20] * len(laboratory.thermometers.type_codes)


def _silent_camera(laboratory: Laboratory, value: object) -> None:
    laboratory.camera.faults.silent_gvcp = laboratory.camera.faults.silent_gvsp = bool(value)


def _camera_without_stream(laboratory: Laboratory, value: object) -> None:
    laboratory.camera.faults.no_stream_channel = bool(value)
    if value:
        laboratory.camera.restart()


def _make_axis_setter(attribute: str, kind: Callable[[object], object] = bool) -> Callable[[FakeAxis, object], None]:
    return lambda axis, value: setattr(axis, attribute, kind(value))


def _make_danger_setter(bits: int) -> Callable[[FakeAxis, object], None]:
    return lambda axis, value: setattr(axis, "danger", axis.danger & ~bits | (bits if value else 0))


# Kind -> what is done to the axis, worst value, the one that mends it, meaning.
AXIS_FAULTS: dict[str, tuple[Callable[[FakeAxis, object], None], object, object, str]] = {
    "limit_hit": (
        _make_axis_setter("limit", lambda side: str(side or "")),
        "right",
        "",
        "left or right: this switch reads closed",
    ),
    "wrong_limit": (_make_axis_setter("wrong_limit"), True, False, "a stop at a switch is taken for the other one's"),
    "lost_steps": (
        _make_axis_setter("lost_steps", number),
        200,
        0,
        "steps by which the mechanics fall back, the count does not",
    ),
    "jam_steps": (
        _make_axis_setter("stall_steps", number_or_none),
        0,
        None,
        "steps beyond which the mechanics do not go",
    ),
    "ctp_error": (_make_axis_setter("ctp_error"), True, False, "encoder and count differ"),
    "overheated": (_make_danger_setter(FLAG_DRIVER_OVERHEAT), True, False, "the motor's driver is too warm"),
    "winding": (_make_danger_setter(FLAG_WINDING_MISMATCH), True, False, "the windings differ"),
    "endless": (_make_axis_setter("endless"), True, False, "a move does not end"),
    "motor_off": (_make_axis_setter("motor_off"), True, False, "no current; the next move brings it back"),
    "restart": (
        lambda axis, value: axis.power_cycle() if value else None,
        True,
        False,
        "off and on again: not homed, position 0",
    ),
}


def _make_axis_fault(name: str, act: Callable[[FakeAxis, object], None]) -> Setter:
    return lambda laboratory, value: act(laboratory.axis(name), value)


def _make_link_fault(name: str, kind: str) -> Setter:
    return lambda laboratory, value: set_link_fault(laboratory.link(name), kind, value)


def make_link_and_axis_faults(links: Iterable[str], axes: Iterable[str]) -> dict[str, Breakage]:
    """Every link has the same, `bus.drop`, `linear.drop`, ..., and every axis, `linear.limit_hit`, ..."""
    of_links = {
        f"{name}.{kind}": Breakage(_make_link_fault(name, kind), worst, mended, text, locks=False)
        for name in links
        for kind, (worst, mended, text) in LINK_FAULTS.items()
    }
    return of_links | {
        f"{name}.{kind}": Breakage(_make_axis_fault(name, act), worst, mended, text)
        for name in axes
        for kind, (act, worst, mended, text) in AXIS_FAULTS.items()
    }


FAULTS: dict[str, Breakage] = {
    **make_link_and_axis_faults(("bus", "chamber", *AXES), AXES),
    # The regulator and its probe.
    "regulator.silent": make_flag("regulator.silent", "it does not answer"),
    "regulator.compoway": make_flag("regulator.compoway", "back to its own protocol"),
    "regulator.restart": make_once("regulator.power_cycle", "off and on again"),
    "regulator.sensor_break": make_flag("regulator.sensor_break", "open sensor"),
    "regulator.ad_error": make_flag("regulator.ad_error", "its converter has failed"),
    "regulator.pv_offset_K": make_amount("regulator.pv_offset_K", 5.0, "it reads wrong"),
    "regulator.stuck_pv_degC": make_held_number("regulator.stuck_pv_degC", 24.0, "its PV stays there"),
    "regulator.pv_drift_K_per_h": make_amount("regulator.pv_drift_K_per_h", 5.0, "its PV drifts"),
    "regulator.probe_out": make_flag("regulator.probe_out", "its probe hangs in the laboratory"),
    "regulator.probe_exchanged": Breakage(_exchange_probes, True, False, "its probe with the air's thermometer"),
    "regulator.set_point_degC": make_number_call("regulator.press_setpoint", 45.0, "somebody changes it with the keys"),
    "regulator.set_point_clamp_degC": Breakage(
        _clamp_set_point, (15.0, 30.0), None, "[low, high]: it takes no set-point outside, and acknowledges it"
    ),
    "regulator.acting_degC": make_held_number(
        "regulator.acting_degC", 45.0, "another set-point acts: multi-SP, or the remote one"
    ),
    "regulator.ramp_K_per_min": make_held_number("regulator.ramp_K_per_min", 0.5, "a ramp of its own"),
    "regulator.stop_key": make_once("regulator.press_stop", "somebody stops control"),
    "regulator.manual_percent": Breakage(_press_manual, 50.0, None, "somebody dials in a heating output"),
    "regulator.autotune": Breakage(
        lambda lab, value: lab.regulator.press_autotune(bool(value)), True, False, "somebody starts it with the keys"
    ),
    "regulator.decimals": make_whole_number("regulator.display_decimals", 0, 1, "its decimal point"),
    # Contact thermometers; values by the channel's name.
    "thermometer.open": make_sensor_fault("open_channels", _channel, _AIR, "this one's wire is broken"),
    "thermometer.shorted": make_sensor_fault("shorted_channels", _channel, _AIR, "this one is shorted"),
    "thermometer.pulled_out": make_sensor_fault("pulled_out", _channel, _AIR, "this one hangs in the laboratory"),
    "thermometer.noisy": make_sensor_fault(
        "noisy_channel",
        lambda lab, value: next(iter(_channel(lab, value)), None),
        _AIR,
        "this one has 1 K of noise",
    ),
    "thermometer.offset_K": make_sensor_fault("offset_K", _numbers, {_AIR: 5.0}, "{name: K}"),
    "thermometer.drift_K_per_h": make_sensor_fault("drift_K_per_h", _numbers, {_AIR: 2.0}, "{name: K/h}"),
    "thermometer.stuck_degC": make_sensor_fault("stuck_degC", _numbers, {_AIR: 24.0}, "{name: degC}"),
    "thermometer.held_degC": make_sensor_fault(
        "held_degC", _numbers, {_AIR: 24.0}, "{name: degC}, with the converter's noise"
    ),
    "thermometers.silent": make_flag("thermometers.silent", "they do not answer"),
    "thermometers.no_fault_bits": make_flag("thermometers.no_fault_bits", "unreadable: their values are STALE"),
    "thermometers.wrong_type": Breakage(_wrong_module, True, False, "a module with another range"),
    # A climate chamber with a controller of its own.
    "chamber.mute": make_flag("chamber.silent", "it does not answer"),
    "chamber.ignores_writes": make_flag("chamber.ignores_writes", "not in remote"),
    "chamber.protected": make_flag("chamber.protected", "the panel refuses (ESPEC)"),
    "chamber.clamps": make_flag("chamber.clamps", "it cuts set-points silently"),
    "chamber.alarm": Breakage(make_setter("chamber.alarm", lambda value: str(value or "")), "31", "", "its code"),
    "chamber.humidity": make_flag("chamber.humidity_on", "it is on"),
    "chamber.stuck_degC": make_held_number("chamber.stuck_degC", 24.0, "its own sensor stays there"),
    "chamber.set_point_degC": make_number_call("chamber.press_setpoint", 45.0, "somebody changes it at the panel"),
    "chamber.program_degC": make_held_number("chamber.program_degC", 45.0, "a program of its own runs, and goes there"),
    "chamber.bank": make_whole_number("chamber.bank", 1, 0, "working temperature that acts: 0 is T1 (Julabo)"),
    "chamber.stop_key": make_once("chamber.press_stop", "somebody stops it"),
    "chamber.restart": make_once("chamber.restart", "a power failure: it is stopped"),
    # The plant, and the relays.
    "heater.cut_out": make_flag("plant.cut_out_open", "the thermal cut-out is open"),
    "heater.welded_share": Breakage(
        make_setter("ssr_welded_share", number), 1.0, None, "its solid-state relay conducts this share"
    ),
    "inputs.changed": Breakage(_change_contact, None, None, "name of a contact that is not as it is while all is well"),
    "relays.silent": make_flag("relays.silent", "the board does not answer"),
    "relays.silent_s": Breakage(_silent_relays, 60.0, 0, "for so long; its timed-on relays time out and drop"),
    "relays.lost_writes": make_flag("relays.lost_writes", "acknowledged, not done"),
    "relays.brown_out": make_once("relays.power_cycle", "every relay opens"),
    "relays.welded": Breakage(
        make_setter("relays.welded", lambda value: {str(value)} if value else set[str]()),
        "heater_enable",
        None,
        "this contact conducts regardless of the coil",
    ),
    "relays.no_rearm": Breakage(
        make_setter("relays.rearms", lambda value: not value),
        True,
        False,
        "a timed-on that runs does not start its time again",
    ),
    "relays.no_timer": Breakage(
        make_setter("relays.times", lambda value: not value), True, False, "a timed-on stays on"
    ),
    # The analog output of a regulator of our own.
    "heat_module.silent": make_flag("heat_module.silent", "it does not answer"),
    "heat_module.stuck_mA": make_held_number("heat_module.stuck_mA", 12.0, "it gives this, whatever is written"),
    "heat_module.lost_writes": make_flag("heat_module.lost_writes", "writes to its outputs are acknowledged, not done"),
    "heat_module.restart": make_once("heat_module.power_cycle", "off and on again"),
    "heat_module.refreshed_by": Breakage(
        make_setter("heat_module.refreshed_by", str), "nothing", "requests", "what its watchdog is kept by"
    ),
    "heat_module.written_mA": make_number_call("heat_module.write_mA", 12.0, "another master writes this to it"),
    # Axes by the name of the axis, as value.
    "axis.alarm": Breakage(_alarm_axis, "linear", None, "the alarm of this axis stands"),
    # The flap.
    "flap.jam": make_held_number("flap.jam_position", 2000, "feedback counts at which it stops"),
    "flap.error": Breakage(
        make_setter("flap.active_errors", lambda value: _ERRORS[str(value)] if value else 0),
        "feedback",
        None,
        "feedback, power or current: this error bit stands",
    ),
    "flap.unplugged": make_flag("flap.unplugged", "off the USB"),
    "flap.stall": make_flag("flap.stall", "its transfers stall (EPIPE)"),
    "flap.timeout": make_flag("flap.timeout", "its transfers time out"),
    "flap.short_read": make_flag("flap.short_read", "half of each reply"),
    "flap.restart": make_once("flap.restart", "its controller restarts"),
    # The thermal imager.
    "imager.stopped": make_flag("imager.stopped", "stores no more pictures"),
    "imager.cut": make_flag("imager.cut", "its files end too early; mended, they go on"),
    "imager.plain": make_flag("imager.plain", "pictures without temperatures"),
    "imager.damaged": make_flag("imager.damaged", "the counts lack their end"),
    "imager.clock_s": make_amount("imager.clock_s", 3600.0, "its clock is ahead by this"),
    "imager.serial_number": Breakage(
        make_setter("imager.serial_number", str), "49009999", SERIAL_NUMBER, "pictures of another imager"
    ),
    "imager.again": make_flag("imager.again", "the last picture under new names"),
    "imager.unplugged": make_flag("imager.unplugged", "its folder is gone"),
    # The UPS, and upsd.
    "ups.mains_failed": make_flag("ups.mains_failed", "the mains have failed, and it is on battery"),
    "ups.charge_percent": make_number_call("ups.set_charge", 25.0, "what is left in its battery"),
    "ups.status": make_held_word("ups.status", "OB LB", "its status reads so"),
    "ups.stale": make_flag("ups.stale", "upsd has no fresh data of it"),
    "ups.driver_gone": make_flag("ups.driver_gone", "its driver is not connected to upsd"),
    # The camera that is named so, or the first.
    "camera.loss": make_amount("camera.faults.loss", 0.05, "share of stream packets lost"),
    "camera.burst": make_whole_number("camera.faults.burst", 20, 1, "packets lost in a row"),
    "camera.no_resend": make_flag("camera.faults.no_resend", "nothing is sent again"),
    "camera.no_leader": make_flag("camera.faults.drop_leader", "frames lack it"),
    "camera.no_trailer": make_flag("camera.faults.drop_trailer", "frames lack it"),
    "camera.trigger_twice": make_flag("camera.faults.trigger_twice", "a trigger gives two frames"),
    "camera.truncated": make_amount("camera.faults.truncated", 0.05, "share of packets cut in half"),
    "camera.doubled": make_amount("camera.faults.doubled", 0.05, "share of packets sent twice"),
    "camera.reordered": make_amount("camera.faults.reordered", 0.05, "share of packets sent late"),
    "camera.leader_early_s": make_amount(
        "camera.faults.leader_early_s", 0.4, "leaders are so far ahead of the payload"
    ),
    "camera.stretch_s": make_amount("camera.faults.stretch_s", 0.4, "the payload takes so long"),
    "camera.unpaced": make_flag("camera.faults.unpaced", "packets leave in one burst"),
    "camera.acks_twice": make_flag("camera.faults.acks_twice", "each answer twice"),
    "camera.pending": make_whole_number("camera.faults.pending", 3, 0, "answers are late"),
    "camera.stamp_zero": make_shown_word("camera.faults.stamp", "zero", "its time stamps are 0"),
    "camera.stamp_backwards": make_shown_word("camera.faults.stamp", "backwards", "its time stamps run backwards"),
    "camera.no_ticks": make_flag("camera.faults.no_ticks", "its clock does not tick"),
    "camera.silent": Breakage(_silent_camera, True, False, "neither answers nor sends"),
    "camera.stalled": make_flag("camera.faults.silent_gvsp", "answers, but sends no frame"),
    "camera.deaf": make_flag("camera.faults.silent_gvcp", "sends, but does not answer"),
    "camera.control_lost": Breakage(
        lambda lab, value: lab.camera.seize(bool(value)), True, False, "another client has taken control of it"
    ),
    "camera.restart": make_once("camera.restart", "by itself, its supply on"),
    "camera.no_stream_channel": Breakage(_camera_without_stream, True, False, "it restarts, and does not offer one"),
    "camera.sensor_degC": make_held_number("camera_sensor_degC", 75.0, "its sensor chip stays at this"),
    "camera.frozen_temperature": make_shown_word("camera.faults.temperature", "stuck", "it keeps showing the last one"),
    "camera.no_temperature": make_shown_word("camera.faults.temperature", "zero", "it shows 0 degC"),
    "camera.refused_temperature": make_shown_word("camera.faults.temperature", "access", "its register cannot be read"),
    "camera.temperature_offset_K": make_amount("camera.faults.temperature_offset_K", 10.0, "it shows a wrong one"),
}


def make_table(known: Mapping[str, Breakage] = FAULTS) -> list[dict[str, object]]:
    """Faults for people and programs: name, worst, mended, text."""
    return [
        {"name": name, "worst": fault.worst, "mended": fault.mended, "text": fault.text}
        for name, fault in sorted(known.items())
    ]


# Faults in advance: what breaks when, and for how long, in one line of text each.
#
#     NAME[=VALUE][@TIME][:DURATION]        bus.drop=0.1@20min:60     flap.jam     thermometer.offset_K={"air": 3}@2h
#
# TIME counts from the laboratory's start, DURATION from then on; both in s unless they end in s, min or h. Without TIME
# it breaks at once, without DURATION it stays broken, without VALUE it breaks as badly as the table says.


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


def parse_fault(text: str, known: Mapping[str, Breakage] = FAULTS) -> PlannedFault:
    """One line of text; ConfigError when it is none, or names none of the faults that are known."""
    found = _FORM.fullmatch(text.strip())
    if found is None:
        raise ConfigError(f"fault {text!r}: expected NAME[=VALUE][@TIME][:DURATION], such as bus.drop=0.1@20min:60")
    name, value, at, at_unit, length, length_unit = found.groups()
    if name not in known:
        near = get_close_matches(name, known, n=3, cutoff=0.4)
        hint = f"did you mean {', '.join(near)}?" if near else "`stand simulate --faults` lists them"
        raise ConfigError(f"fault {text!r}: there is no {name}; {hint}")
    at_s = float(at) * _SECONDS[at_unit] if at else 0.0
    for_s = float(length) * _SECONDS[length_unit] if length else None
    return PlannedFault(name, known[name].worst if value is None else _value(value), at_s, for_s)


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
        self.known = list_known_faults(laboratory)
        self._lock = threading.Lock()
        self._due: list[tuple[int, int, str, object]] = []
        self._number = itertools.count()
        self._ends: dict[str, int] = {}  # the number of the end of what was broken by hand
        self._standing: dict[str, object] = {}
        start_ns = laboratory.now_ns
        for planned in faults:
            if planned.at_s > 0 and not isinstance(self.known[planned.name].apply, Once):
                self._set(planned.name, planned.value)
                self._set(planned.name, self.known[planned.name].mended)
            at_ns = start_ns + to_ns(planned.at_s)
            self._push(at_ns, planned.name, planned.value)
            if planned.for_s is not None:
                self._push(at_ns + to_ns(planned.for_s), planned.name, self.known[planned.name].mended)
        self._break_until(start_ns)

    def list_standing(self) -> dict[str, object]:
        """Return what is broken now, with its value; what just happens (a restart) is not."""
        with self._lock:
            return dict(self._standing)

    def break_now(self, name: str, value: object, for_s: float | None) -> None:
        """Break something by hand; None: until it is mended. ConfigError when there is no such fault, or this
        laboratory cannot have it. The end of one that was broken by hand before is forgotten."""
        if name not in self.known:
            raise ConfigError(f"there is no fault {name}")
        with self._lock:
            self._set(name, value)
            self._forget_end(name)
            if for_s is not None:
                self._ends[name] = self._push(self._laboratory.now_ns + to_ns(for_s), name, self.known[name].mended)

    def mend(self, name: str) -> None:
        """Mend a fault by hand; ConfigError as in `break_now`."""
        if name not in self.known:
            raise ConfigError(f"there is no fault {name}")
        with self._lock:
            self._set(name, self.known[name].mended)
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
        """Make what has become due happen, in real time; ConfigError when this laboratory cannot have it."""
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
        if value == self.known[name].mended or isinstance(self.known[name].apply, Once):
            self._standing.pop(name, None)
        else:
            self._standing[name] = value
