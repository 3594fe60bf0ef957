"""What can be broken in a simulated laboratory: one table, name -> how, with which value, and how it is mended.

A name begins with the device or the link. Every fault is set by a value, which is its `worst` unless another is given,
and undone by its `mended` one. A fault that cannot be undone (somebody pressed a key) just ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from pydantic import TypeAdapter

from thermostand.drivers.sim.laboratory import Laboratory
from thermostand.drivers.sim.laboratory_fault import Fault, Setter, flag, given, number, number_or_none, once, shown, to
from thermostand.drivers.sim.link_faults import LINK_FAULTS, set_link_fault
from thermostand.drivers.sim.motion.flap import ERROR_FEEDBACK_DISCONNECT, ERROR_HARD_OVER_CURRENT, ERROR_NO_POWER
from thermostand.drivers.sim.motion.ximc import FakeAxis
from thermostand.drivers.sim.motion.ximc_table import FLAG_DRIVER_OVERHEAT, FLAG_WINDING_MISMATCH
from thermostand.drivers.sim.units.thermal_imager import SERIAL_NUMBER
from thermostand.foundation.clock import seconds_ns

_AXES = ("linear", "rotary")
_AIR = "air"
_ERRORS = {"feedback": ERROR_FEEDBACK_DISCONNECT, "power": ERROR_NO_POWER, "current": ERROR_HARD_OVER_CURRENT}


def inject(laboratory: Laboratory, name: str, value: object) -> None:
    """Set one of FAULTS to `value`; KeyError, TypeError or ValueError when name or value is none."""
    fault = FAULTS[name]
    if not fault.locks:
        return fault.apply(laboratory, value)
    with laboratory.plant.lock:
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


def _thermometers(attribute: str, kind: Callable[[Laboratory, object], object]) -> Setter:
    def apply(laboratory: Laboratory, value: object) -> None:
        changed = kind(laboratory, value)
        for module in laboratory.thermometer_modules:
            setattr(module, attribute, changed)

    return apply


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
    until_ns = plant.now_ns + seconds_ns(number(value))
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


def _axis_faults() -> Iterator[tuple[str, Fault]]:
    """Every axis has the same."""

    def cycle(axis: FakeAxis, value: object) -> None:
        if value:
            axis.power_cycle()

    def its(attribute: str, kind: Callable[[object], object]) -> Callable[[FakeAxis, object], None]:
        return lambda axis, value: setattr(axis, attribute, kind(value))

    def danger(bits: int) -> Callable[[FakeAxis, object], None]:
        return lambda axis, value: setattr(axis, "danger", axis.danger & ~bits | (bits if value else 0))

    faults: dict[str, tuple[Callable[[FakeAxis, object], None], object, object, str]] = {
        "limit_hit": (
            its("limit", lambda side: str(side or "")),
            "right",
            "",
            "left or right: this switch reads closed",
        ),
        "wrong_limit": (its("wrong_limit", bool), True, False, "a stop at a switch is taken for the other one's"),
        "lost_steps": (its("lost_steps", number), 200, 0, "steps by which the mechanics fall back, the count does not"),
        "jam_steps": (its("stall_steps", number_or_none), 0, None, "steps beyond which the mechanics do not go"),
        "ctp_error": (its("ctp_error", bool), True, False, "encoder and count differ"),
        "overheated": (danger(FLAG_DRIVER_OVERHEAT), True, False, "the motor's driver is too warm"),
        "winding": (danger(FLAG_WINDING_MISMATCH), True, False, "the windings differ"),
        "endless": (its("endless", bool), True, False, "a move does not end"),
        "motor_off": (its("motor_off", bool), True, False, "no current; the next move brings it back"),
        "restart": (cycle, True, False, "off and on again: not homed, position 0"),
    }
    for name in _AXES:
        for kind, (act, worst, mended, text) in faults.items():

            def apply(
                laboratory: Laboratory,
                value: object,
                name: str = name,
                act: Callable[[FakeAxis, object], None] = act,
            ) -> None:
                act(laboratory.axis(name), value)

            yield f"{name}.{kind}", Fault(apply, worst, mended, text)


def _link_faults() -> Iterator[tuple[str, Fault]]:
    """Every link has the same, `bus.drop`, `linear.drop`, ..."""
    for link in ("bus", "chamber", *_AXES):
        for kind, (worst, mended, text) in LINK_FAULTS.items():

            def apply(laboratory: Laboratory, value: object, link: str = link, kind: str = kind) -> None:
                set_link_fault(
                    laboratory.link("regulator" if link == "chamber" and link not in laboratory.fakes else link),
                    kind,
                    value,
                )

            yield f"{link}.{kind}", Fault(apply, worst, mended, text, locks=False)


FAULTS: dict[str, Fault] = {
    **dict(_link_faults()),
    **dict(_axis_faults()),
    # The regulator and its probe.
    "regulator.silent": flag("regulator.silent", "it does not answer"),
    "regulator.compoway": flag("regulator.compoway", "back to its own protocol"),
    "regulator.restart": once("regulator.power_cycle", "off and on again"),
    "regulator.sensor_break": flag("regulator.sensor_break", "open sensor"),
    "regulator.ad_error": flag("regulator.ad_error", "its converter has failed"),
    "regulator.pv_offset_K": Fault(to("regulator.pv_offset_K", number), 5.0, 0.0, "it reads wrong"),
    "regulator.stuck_pv_degC": Fault(to("regulator.stuck_pv_degC", number_or_none), 24.0, None, "its PV stays there"),
    "regulator.pv_drift_K_per_h": Fault(to("regulator.pv_drift_K_per_h", number), 5.0, 0.0, "its PV drifts"),
    "regulator.probe_out": flag("regulator.probe_out", "its probe hangs in the laboratory"),
    "regulator.probe_exchanged": Fault(_exchange_probes, True, False, "its probe with the air's thermometer"),
    "regulator.set_point_degC": Fault(
        given("regulator.press_setpoint"), 45.0, None, "somebody changes it with the keys"
    ),
    "regulator.set_point_clamp_degC": Fault(
        _clamp_set_point, (15.0, 30.0), None, "[low, high]: it takes no set-point outside, and acknowledges it"
    ),
    "regulator.acting_degC": Fault(
        to("regulator.acting_degC", number_or_none), 45.0, None, "another set-point acts: multi-SP, or the remote one"
    ),
    "regulator.ramp_K_per_min": Fault(to("regulator.ramp_K_per_min", number_or_none), 0.5, None, "a ramp of its own"),
    "regulator.stop_key": once("regulator.press_stop", "somebody stops control"),
    "regulator.manual_percent": Fault(_press_manual, 50.0, None, "somebody dials in a heating output"),
    "regulator.autotune": Fault(
        lambda lab, value: lab.regulator.press_autotune(bool(value)), True, False, "somebody starts it with the keys"
    ),
    "regulator.decimals": Fault(
        to("regulator.display_decimals", lambda value: int(number(value))), 0, 1, "its decimal point"
    ),
    # Contact thermometers; values by the channel's name.
    "thermometer.open": Fault(_thermometers("open_channels", _channel), _AIR, None, "this one's wire is broken"),
    "thermometer.shorted": Fault(_thermometers("shorted_channels", _channel), _AIR, None, "this one is shorted"),
    "thermometer.pulled_out": Fault(
        _thermometers("pulled_out", _channel), _AIR, None, "this one hangs in the laboratory"
    ),
    "thermometer.noisy": Fault(
        _thermometers("noisy_channel", lambda lab, value: next(iter(_channel(lab, value)), None)),
        _AIR,
        None,
        "this one has 1 K of noise",
    ),
    "thermometer.offset_K": Fault(_thermometers("offset_K", _numbers), {_AIR: 5.0}, None, "{name: K}"),
    "thermometer.drift_K_per_h": Fault(_thermometers("drift_K_per_h", _numbers), {_AIR: 2.0}, None, "{name: K/h}"),
    "thermometer.stuck_degC": Fault(_thermometers("stuck_degC", _numbers), {_AIR: 24.0}, None, "{name: degC}"),
    "thermometer.held_degC": Fault(
        _thermometers("held_degC", _numbers), {_AIR: 24.0}, None, "{name: degC}, with the converter's noise"
    ),
    "thermometers.silent": flag("thermometers.silent", "they do not answer"),
    "thermometers.no_fault_bits": flag("thermometers.no_fault_bits", "unreadable: their values are STALE"),
    "thermometers.wrong_type": Fault(_wrong_module, True, False, "a module with another range"),
    # A climate chamber with a controller of its own.
    "chamber.mute": flag("chamber.silent", "it does not answer"),
    "chamber.ignores_writes": flag("chamber.ignores_writes", "not in remote"),
    "chamber.protected": flag("chamber.protected", "the panel refuses (ESPEC)"),
    "chamber.clamps": flag("chamber.clamps", "it cuts set-points silently"),
    "chamber.alarm": Fault(to("chamber.alarm", lambda value: str(value or "")), "31", "", "its code"),
    "chamber.humidity": flag("chamber.humidity_on", "it is on"),
    "chamber.stuck_degC": Fault(to("chamber.stuck_degC", number_or_none), 24.0, None, "its own sensor stays there"),
    "chamber.set_point_degC": Fault(given("chamber.press_setpoint"), 45.0, None, "somebody changes it at the panel"),
    "chamber.program_degC": Fault(
        to("chamber.program_degC", number_or_none), 45.0, None, "a program of its own runs, and goes there"
    ),
    "chamber.bank": Fault(
        to("chamber.bank", lambda value: int(number(value))), 1, 0, "working temperature that acts: 0 is T1 (Julabo)"
    ),
    "chamber.stop_key": once("chamber.press_stop", "somebody stops it"),
    "chamber.restart": once("chamber.restart", "a power failure: it is stopped"),
    # The plant, and the relays.
    "heater.cut_out": flag("plant.cut_out_open", "the thermal cut-out is open"),
    "heater.welded_share": Fault(
        to("ssr_welded_share", number), 1.0, None, "its solid-state relay conducts this share"
    ),
    "inputs.changed": Fault(_change_contact, None, None, "name of a contact that is not as it is while all is well"),
    "relays.silent": flag("relays.silent", "the board does not answer"),
    "relays.silent_s": Fault(_silent_relays, 60.0, 0, "for so long; its timed-on relays time out and drop"),
    "relays.lost_writes": flag("relays.lost_writes", "acknowledged, not done"),
    "relays.brown_out": once("relays.power_cycle", "every relay opens"),
    "relays.welded": Fault(
        to("relays.welded", lambda value: {str(value)} if value else set[str]()),
        "heater_enable",
        None,
        "this contact conducts regardless of the coil",
    ),
    "relays.no_rearm": Fault(
        to("relays.rearms", lambda value: not value),
        True,
        False,
        "a timed-on that runs does not start its time again",
    ),
    "relays.no_timer": Fault(to("relays.times", lambda value: not value), True, False, "a timed-on stays on"),
    # The analog output of a regulator of our own.
    "heat_module.silent": flag("heat_module.silent", "it does not answer"),
    "heat_module.stuck_mA": Fault(
        to("heat_module.stuck_mA", number_or_none), 12.0, None, "it gives this, whatever is written"
    ),
    "heat_module.lost_writes": flag("heat_module.lost_writes", "writes to its outputs are acknowledged, not done"),
    "heat_module.restart": once("heat_module.power_cycle", "off and on again"),
    "heat_module.refreshed_by": Fault(
        to("heat_module.refreshed_by", str), "nothing", "requests", "what its watchdog is kept by"
    ),
    "heat_module.written_mA": Fault(given("heat_module.write_mA"), 12.0, None, "another master writes this to it"),
    # Axes by the name of the axis, as value.
    "axis.alarm": Fault(_alarm_axis, "linear", None, "the alarm of this axis stands"),
    # The flap.
    "flap.jam": Fault(to("flap.jam_position", number_or_none), 2000, None, "feedback counts at which it stops"),
    "flap.error": Fault(
        to("flap.active_errors", lambda value: _ERRORS[str(value)] if value else 0),
        "feedback",
        None,
        "feedback, power or current: this error bit stands",
    ),
    "flap.unplugged": flag("flap.unplugged", "off the USB"),
    "flap.stall": flag("flap.stall", "its transfers stall (EPIPE)"),
    "flap.timeout": flag("flap.timeout", "its transfers time out"),
    "flap.short_read": flag("flap.short_read", "half of each reply"),
    "flap.restart": once("flap.restart", "its controller restarts"),
    # The thermal imager.
    "imager.stopped": flag("imager.stopped", "stores no more pictures"),
    "imager.cut": flag("imager.cut", "its files end too early; mended, they go on"),
    "imager.plain": flag("imager.plain", "pictures without temperatures"),
    "imager.damaged": flag("imager.damaged", "the counts lack their end"),
    "imager.clock_s": Fault(to("imager.clock_s", number), 3600.0, 0.0, "its clock is ahead by this"),
    "imager.serial_number": Fault(
        to("imager.serial_number", str), "49009999", SERIAL_NUMBER, "pictures of another imager"
    ),
    "imager.again": flag("imager.again", "the last picture under new names"),
    "imager.unplugged": flag("imager.unplugged", "its folder is gone"),
    # The camera that is named so, or the first.
    "camera.loss": Fault(to("camera.faults.loss", number), 0.05, 0.0, "share of stream packets lost"),
    "camera.burst": Fault(to("camera.faults.burst", lambda value: int(number(value))), 20, 1, "packets lost in a row"),
    "camera.no_resend": flag("camera.faults.no_resend", "nothing is sent again"),
    "camera.no_leader": flag("camera.faults.drop_leader", "frames lack it"),
    "camera.no_trailer": flag("camera.faults.drop_trailer", "frames lack it"),
    "camera.trigger_twice": flag("camera.faults.trigger_twice", "a trigger gives two frames"),
    **{
        f"camera.{name}": Fault(to(f"camera.faults.{name}", number), 0.05, 0.0, f"share of packets {text}")
        for name, text in (("truncated", "cut in half"), ("doubled", "sent twice"), ("reordered", "sent late"))
    },
    "camera.leader_early_s": Fault(
        to("camera.faults.leader_early_s", number), 0.4, 0.0, "leaders are so far ahead of the payload"
    ),
    "camera.stretch_s": Fault(to("camera.faults.stretch_s", number), 0.4, 0.0, "the payload takes so long"),
    "camera.unpaced": flag("camera.faults.unpaced", "packets leave in one burst"),
    "camera.acks_twice": flag("camera.faults.acks_twice", "each answer twice"),
    "camera.pending": Fault(to("camera.faults.pending", lambda value: int(number(value))), 3, 0, "answers are late"),
    "camera.stamp_zero": shown("camera.faults.stamp", "zero", "its time stamps are 0"),
    "camera.stamp_backwards": shown("camera.faults.stamp", "backwards", "its time stamps run backwards"),
    "camera.no_ticks": flag("camera.faults.no_ticks", "its clock does not tick"),
    "camera.silent": Fault(_silent_camera, True, False, "neither answers nor sends"),
    "camera.stalled": flag("camera.faults.silent_gvsp", "answers, but sends no frame"),
    "camera.deaf": flag("camera.faults.silent_gvcp", "sends, but does not answer"),
    "camera.control_lost": Fault(
        lambda lab, value: lab.camera.seize(bool(value)), True, False, "another client has taken control of it"
    ),
    "camera.restart": once("camera.restart", "by itself, its supply on"),
    "camera.no_stream_channel": Fault(_camera_without_stream, True, False, "it restarts, and does not offer one"),
    "camera.sensor_degC": Fault(to("camera_sensor_degC", number_or_none), 75.0, None, "its sensor chip stays at this"),
    "camera.frozen_temperature": shown("camera.faults.temperature", "stuck", "it keeps showing the last one"),
    "camera.no_temperature": shown("camera.faults.temperature", "zero", "it shows 0 degC"),
    "camera.refused_temperature": shown("camera.faults.temperature", "access", "its register cannot be read"),
    "camera.temperature_offset_K": Fault(
        to("camera.faults.temperature_offset_K", number), 10.0, 0.0, "it shows a wrong one"
    ),
}


def table() -> list[dict[str, object]]:
    """FAULTS for people and programs: name, worst, mended, text."""
    return [
        {"name": name, "worst": fault.worst, "mended": fault.mended, "text": fault.text}
        for name, fault in sorted(FAULTS.items())
    ]
