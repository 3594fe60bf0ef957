"""What can be broken in a simulated laboratory: one table, name -> how, with which value, and how it is mended.

A name begins with the device or the link. Every fault is set by a value, which is its `worst` unless another is given,
and undone by its `mended` one. A fault that cannot be undone (somebody pressed a key) just ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from pydantic import TypeAdapter

from drivers.sim.axis_faults import AXES, axis_faults
from drivers.sim.laboratory import Laboratory
from drivers.sim.laboratory_fault import Fault, Once, Setter, number, number_or_none, to
from drivers.sim.link_faults import LINK_FAULTS, set_link_fault
from drivers.sim.motion.flap import ERROR_FEEDBACK_DISCONNECT, ERROR_HARD_OVER_CURRENT, ERROR_NO_POWER
from drivers.sim.units.thermal_imager import SERIAL_NUMBER
from foundation.clock import seconds_ns

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
    return {laboratory.spec.thermometer_channels[name]: number for name, number in named.items()}


def _channel(laboratory: Laboratory, value: object) -> set[int]:
    return {laboratory.spec.thermometer_channels[str(value)]} if value else set()


def _thermometers(attribute: str, kind: Callable[[Laboratory, object], object]) -> Setter:
    def apply(laboratory: Laboratory, value: object) -> None:
        for module in laboratory.thermometer_modules:
            setattr(module, attribute, kind(laboratory, value))

    return apply


def _noisy(laboratory: Laboratory, value: object) -> int | None:
    return next(iter(_channel(laboratory, value)), None)


def _exchange_probes(laboratory: Laboratory, value: object) -> None:
    laboratory.regulator.probe_exchanged = laboratory.thermometers.air_exchanged = bool(value)


def _press_manual(laboratory: Laboratory, value: object) -> None:
    if value is None:
        laboratory.regulator.press_automatic()
    else:
        laboratory.regulator.press_manual(float(str(value)))


def _press_set_point(laboratory: Laboratory, value: object) -> None:
    if value is not None:
        laboratory.regulator.press_setpoint(float(str(value)))


def _press_chamber(laboratory: Laboratory, value: object) -> None:
    if value is not None:
        laboratory.chamber.press_setpoint(float(str(value)))


def _write_output(laboratory: Laboratory, value: object) -> None:
    if value is not None:
        laboratory.heat_module.write_mA(float(str(value)))


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


def _weld(laboratory: Laboratory, value: object) -> None:
    laboratory.relays.welded = {str(value)} if value else set()


def _change_contact(laboratory: Laboratory, value: object) -> None:
    spec, closed = laboratory.spec, set(laboratory.spec.inputs_closed)
    changed = {spec.input_channels[str(value)]} if value else set[int]()
    if laboratory.inputs is not None and spec.inputs_unit is not None:
        laboratory.inputs.closed_inputs = closed ^ changed


def _alarm_axis(laboratory: Laboratory, value: object) -> None:
    for name, axis in laboratory.axes.items():
        axis.alarm = name == value


def _restart_flap(laboratory: Laboratory) -> None:
    laboratory.flap.restart()


def _flap_errors(laboratory: Laboratory, value: object) -> None:
    laboratory.flap.active_errors = _ERRORS[str(value)] if value else 0


def _wrong_module(laboratory: Laboratory, value: object) -> None:
    laboratory.thermometers.type_codes = [0x22 if value else 0x20] * len(laboratory.thermometers.type_codes)


def _stall_stream(laboratory: Laboratory, value: object) -> None:
    laboratory.camera.faults.silent_gvsp = bool(value)


def _silent_camera(laboratory: Laboratory, value: object) -> None:
    laboratory.camera.faults.silent_gvcp = laboratory.camera.faults.silent_gvsp = bool(value)


def _temperature_shown(kind: str) -> Setter:
    return to(lambda lab: lab.camera.faults, "temperature", lambda value: kind if value else None)


def _stamped(kind: str) -> Setter:
    return to(lambda lab: lab.camera.faults, "stamp", lambda value: kind if value else None)


def _camera_without_stream(laboratory: Laboratory, value: object) -> None:
    laboratory.camera.faults.no_stream_channel = bool(value)
    if value:
        laboratory.camera.restart()


def _link_faults() -> Iterator[tuple[str, Fault]]:
    """Every link has the same, `bus.drop`, `linear.drop`, ..."""
    for link in ("bus", "chamber", *AXES):
        for kind, (worst, mended, text) in LINK_FAULTS.items():

            def apply(laboratory: Laboratory, value: object, link: str = link, kind: str = kind) -> None:
                set_link_fault(laboratory.link("regulator" if link == "chamber" else link), kind, value)

            yield f"{link}.{kind}", Fault(apply, worst, mended, text, locks=False)


FAULTS: dict[str, Fault] = {
    **dict(_link_faults()),
    **dict(axis_faults()),
    # The regulator and its probe.
    "regulator.silent": Fault(to(lambda lab: lab.regulator, "silent"), True, False, "it does not answer"),
    "regulator.compoway": Fault(to(lambda lab: lab.regulator, "compoway"), True, False, "back to its own protocol"),
    "regulator.restart": Fault(Once(lambda lab: lab.regulator.power_cycle()), True, False, "off and on again"),
    "regulator.sensor_break": Fault(to(lambda lab: lab.regulator, "sensor_break"), True, False, "open sensor"),
    "regulator.ad_error": Fault(to(lambda lab: lab.regulator, "ad_error"), True, False, "its converter has failed"),
    "regulator.pv_offset_K": Fault(to(lambda lab: lab.regulator, "pv_offset_K", number), 5.0, 0.0, "it reads wrong"),
    "regulator.stuck_pv_degC": Fault(
        to(lambda lab: lab.regulator, "stuck_pv_degC", number_or_none), 24.0, None, "its PV stays there"
    ),
    "regulator.pv_drift_K_per_h": Fault(
        to(lambda lab: lab.regulator, "pv_drift_K_per_h", number), 5.0, 0.0, "its PV drifts"
    ),
    "regulator.probe_out": Fault(
        to(lambda lab: lab.regulator, "probe_out"), True, False, "its probe hangs in the laboratory"
    ),
    "regulator.probe_exchanged": Fault(_exchange_probes, True, False, "its probe with the air's thermometer"),
    "regulator.set_point_degC": Fault(_press_set_point, 45.0, None, "somebody changes it with the keys"),
    "regulator.set_point_clamp_degC": Fault(
        _clamp_set_point, (15.0, 30.0), None, "[low, high]: it takes no set-point outside, and acknowledges it"
    ),
    "regulator.stop_key": Fault(Once(lambda lab: lab.regulator.press_stop()), True, False, "somebody stops control"),
    "regulator.manual_percent": Fault(_press_manual, 50.0, None, "somebody dials in a heating output"),
    "regulator.autotune": Fault(
        lambda lab, value: lab.regulator.press_autotune(bool(value)), True, False, "somebody starts it with the keys"
    ),
    "regulator.decimals": Fault(
        to(lambda lab: lab.regulator, "display_decimals", lambda value: int(number(value))), 0, 1, "its decimal point"
    ),
    # Contact thermometers; values by the channel's name.
    "thermometer.open": Fault(_thermometers("open_channels", _channel), _AIR, None, "this one's wire is broken"),
    "thermometer.shorted": Fault(_thermometers("shorted_channels", _channel), _AIR, None, "this one is shorted"),
    "thermometer.pulled_out": Fault(
        _thermometers("pulled_out", _channel), _AIR, None, "this one hangs in the laboratory"
    ),
    "thermometer.noisy": Fault(_thermometers("noisy_channel", _noisy), _AIR, None, "this one has 1 K of noise"),
    "thermometer.offset_K": Fault(_thermometers("offset_K", _numbers), {_AIR: 5.0}, None, "{name: K}"),
    "thermometer.drift_K_per_h": Fault(_thermometers("drift_K_per_h", _numbers), {_AIR: 2.0}, None, "{name: K/h}"),
    "thermometer.stuck_degC": Fault(_thermometers("stuck_degC", _numbers), {_AIR: 24.0}, None, "{name: degC}"),
    "thermometer.held_degC": Fault(
        _thermometers("held_degC", _numbers), {_AIR: 24.0}, None, "{name: degC}, with the converter's noise"
    ),
    "thermometers.silent": Fault(to(lambda lab: lab.thermometers, "silent"), True, False, "they do not answer"),
    "thermometers.no_fault_bits": Fault(
        to(lambda lab: lab.thermometers, "no_fault_bits"), True, False, "unreadable: their values are STALE"
    ),
    "thermometers.wrong_type": Fault(_wrong_module, True, False, "a module with another range"),
    # A climate chamber with a controller of its own.
    "chamber.mute": Fault(to(lambda lab: lab.chamber, "silent"), True, False, "it does not answer"),
    "chamber.ignores_writes": Fault(to(lambda lab: lab.chamber, "ignores_writes"), True, False, "not in remote"),
    "chamber.protected": Fault(to(lambda lab: lab.chamber, "protected"), True, False, "the panel refuses (ESPEC)"),
    "chamber.clamps": Fault(to(lambda lab: lab.chamber, "clamps"), True, False, "it cuts set-points silently"),
    "chamber.alarm": Fault(to(lambda lab: lab.chamber, "alarm", lambda value: str(value or "")), "31", "", "its code"),
    "chamber.humidity": Fault(to(lambda lab: lab.chamber, "humidity_on"), True, False, "it is on"),
    "chamber.stuck_degC": Fault(
        to(lambda lab: lab.chamber, "stuck_degC", number_or_none), 24.0, None, "its own sensor stays there"
    ),
    "chamber.set_point_degC": Fault(_press_chamber, 45.0, None, "somebody changes it at the panel"),
    "chamber.stop_key": Fault(Once(lambda lab: lab.chamber.press_stop()), True, False, "somebody stops it"),
    "chamber.restart": Fault(Once(lambda lab: lab.chamber.restart()), True, False, "a power failure: it is stopped"),
    # The plant, and the relays.
    "heater.cut_out": Fault(to(lambda lab: lab.plant, "cut_out_open"), True, False, "the thermal cut-out is open"),
    "heater.welded_share": Fault(
        to(lambda lab: lab, "ssr_welded_share", number), 1.0, None, "its solid-state relay conducts this share"
    ),
    "inputs.changed": Fault(_change_contact, None, None, "name of a contact that is not as it is while all is well"),
    "relays.silent": Fault(to(lambda lab: lab.relays, "silent"), True, False, "the board does not answer"),
    "relays.silent_s": Fault(_silent_relays, 60.0, 0, "for so long; its timed-on relays time out and drop"),
    "relays.lost_writes": Fault(to(lambda lab: lab.relays, "lost_writes"), True, False, "acknowledged, not done"),
    "relays.brown_out": Fault(Once(lambda lab: lab.relays.power_cycle()), True, False, "every relay opens"),
    "relays.welded": Fault(_weld, "heater_enable", None, "this contact conducts regardless of the coil"),
    "relays.no_rearm": Fault(
        to(lambda lab: lab.relays, "rearms", lambda value: not value),
        True,
        False,
        "a timed-on that runs does not start its time again",
    ),
    "relays.no_timer": Fault(
        to(lambda lab: lab.relays, "times", lambda value: not value), True, False, "a timed-on stays on"
    ),
    # The analog output of a regulator of our own.
    "heat_module.silent": Fault(to(lambda lab: lab.heat_module, "silent"), True, False, "it does not answer"),
    "heat_module.stuck_mA": Fault(
        to(lambda lab: lab.heat_module, "stuck_mA", number_or_none), 12.0, None, "it gives this, whatever is written"
    ),
    "heat_module.lost_writes": Fault(
        to(lambda lab: lab.heat_module, "lost_writes"), True, False, "writes to its outputs are acknowledged, not done"
    ),
    "heat_module.restart": Fault(Once(lambda lab: lab.heat_module.power_cycle()), True, False, "off and on again"),
    "heat_module.refreshed_by": Fault(
        to(lambda lab: lab.heat_module, "refreshed_by", str), "nothing", "requests", "what its watchdog is kept by"
    ),
    "heat_module.written_mA": Fault(_write_output, 12.0, None, "another master writes this to it"),
    # Axes by the name of the axis, as value.
    "axis.alarm": Fault(_alarm_axis, "linear", None, "the alarm of this axis stands"),
    # The flap.
    "flap.jam": Fault(
        to(lambda lab: lab.flap, "jam_position", number_or_none), 2000, None, "feedback counts at which it stops"
    ),
    "flap.error": Fault(_flap_errors, "feedback", None, "feedback, power or current: this error bit stands"),
    "flap.unplugged": Fault(to(lambda lab: lab.flap, "unplugged"), True, False, "off the USB"),
    "flap.stall": Fault(to(lambda lab: lab.flap, "stall"), True, False, "its transfers stall (EPIPE)"),
    "flap.timeout": Fault(to(lambda lab: lab.flap, "timeout"), True, False, "its transfers time out"),
    "flap.short_read": Fault(to(lambda lab: lab.flap, "short_read"), True, False, "half of each reply"),
    "flap.restart": Fault(Once(_restart_flap), True, False, "its controller restarts"),
    # The thermal imager.
    "imager.stopped": Fault(to(lambda lab: lab.imager, "stopped"), True, False, "stores no more pictures"),
    "imager.cut": Fault(to(lambda lab: lab.imager, "cut"), True, False, "its files end too early; mended, they go on"),
    "imager.plain": Fault(to(lambda lab: lab.imager, "plain"), True, False, "pictures without temperatures"),
    "imager.damaged": Fault(to(lambda lab: lab.imager, "damaged"), True, False, "the counts lack their end"),
    "imager.clock_s": Fault(to(lambda lab: lab.imager, "clock_s", number), 3600.0, 0.0, "its clock is ahead by this"),
    "imager.serial_number": Fault(
        to(lambda lab: lab.imager, "serial_number", str), "49009999", SERIAL_NUMBER, "pictures of another imager"
    ),
    "imager.again": Fault(to(lambda lab: lab.imager, "again"), True, False, "the last picture under new names"),
    "imager.unplugged": Fault(to(lambda lab: lab.imager, "unplugged"), True, False, "its folder is gone"),
    # The camera that is named so, or the first.
    "camera.loss": Fault(to(lambda lab: lab.camera.faults, "loss", number), 0.05, 0.0, "share of stream packets lost"),
    "camera.burst": Fault(
        to(lambda lab: lab.camera.faults, "burst", lambda value: int(number(value))), 20, 1, "packets lost in a row"
    ),
    "camera.no_resend": Fault(to(lambda lab: lab.camera.faults, "no_resend"), True, False, "nothing is sent again"),
    "camera.no_leader": Fault(to(lambda lab: lab.camera.faults, "drop_leader"), True, False, "frames lack it"),
    "camera.no_trailer": Fault(to(lambda lab: lab.camera.faults, "drop_trailer"), True, False, "frames lack it"),
    "camera.trigger_twice": Fault(
        to(lambda lab: lab.camera.faults, "trigger_twice"), True, False, "a trigger gives two frames"
    ),
    **{
        f"camera.{name}": Fault(to(lambda lab: lab.camera.faults, name, number), 0.05, 0.0, f"share of packets {text}")
        for name, text in (("truncated", "cut in half"), ("doubled", "sent twice"), ("reordered", "sent late"))
    },
    "camera.leader_early_s": Fault(
        to(lambda lab: lab.camera.faults, "leader_early_s", number), 0.4, 0.0, "leaders are so far ahead of the payload"
    ),
    "camera.stretch_s": Fault(
        to(lambda lab: lab.camera.faults, "stretch_s", number), 0.4, 0.0, "the payload takes so long"
    ),
    "camera.unpaced": Fault(to(lambda lab: lab.camera.faults, "unpaced"), True, False, "packets leave in one burst"),
    "camera.acks_twice": Fault(to(lambda lab: lab.camera.faults, "acks_twice"), True, False, "each answer twice"),
    "camera.pending": Fault(
        to(lambda lab: lab.camera.faults, "pending", lambda value: int(number(value))), 3, 0, "answers are late"
    ),
    "camera.stamp_zero": Fault(_stamped("zero"), True, False, "its time stamps are 0"),
    "camera.stamp_backwards": Fault(_stamped("backwards"), True, False, "its time stamps run backwards"),
    "camera.no_ticks": Fault(to(lambda lab: lab.camera.faults, "no_ticks"), True, False, "its clock does not tick"),
    "camera.silent": Fault(_silent_camera, True, False, "neither answers nor sends"),
    "camera.stalled": Fault(_stall_stream, True, False, "answers, but sends no frame"),
    "camera.deaf": Fault(to(lambda lab: lab.camera.faults, "silent_gvcp"), True, False, "sends, but does not answer"),
    "camera.control_lost": Fault(
        lambda lab, value: lab.camera.seize(bool(value)), True, False, "another client has taken control of it"
    ),
    "camera.restart": Fault(Once(lambda lab: lab.camera.restart()), True, False, "by itself, its supply on"),
    "camera.no_stream_channel": Fault(_camera_without_stream, True, False, "it restarts, and does not offer one"),
    "camera.sensor_degC": Fault(
        to(lambda lab: lab, "camera_sensor_degC", number_or_none), 75.0, None, "its sensor chip stays at this"
    ),
    "camera.frozen_temperature": Fault(_temperature_shown("stuck"), True, False, "it keeps showing the last one"),
    "camera.no_temperature": Fault(_temperature_shown("zero"), True, False, "it shows 0 degC"),
    "camera.refused_temperature": Fault(_temperature_shown("access"), True, False, "its register cannot be read"),
    "camera.temperature_offset_K": Fault(
        to(lambda lab: lab.camera.faults, "temperature_offset_K", number), 10.0, 0.0, "it shows a wrong one"
    ),
}


def table() -> list[dict[str, object]]:
    """FAULTS for people and programs: name, worst, mended, text."""
    return [
        {"name": name, "worst": fault.worst, "mended": fault.mended, "text": fault.text}
        for name, fault in sorted(FAULTS.items())
    ]
