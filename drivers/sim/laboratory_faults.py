"""What can be broken in a simulated laboratory, by name."""

from __future__ import annotations

from collections.abc import Callable

from pydantic import TypeAdapter

from drivers.sim.laboratory import Laboratory
from drivers.sim.wire import TcpWire
from foundation.clock import seconds_ns


def inject(laboratory: Laboratory, name: str, value: object) -> None:
    """Set one of FAULTS; `value` as the fault's own attribute takes it."""
    with laboratory.plant.lock:
        FAULTS[name](laboratory, value)


def _open_thermometer(laboratory: Laboratory, value: object) -> None:
    channels = laboratory.spec.thermometer_channels
    laboratory.thermometers.open_channels = {channels[str(value)]} if value else set()


def _sensor_break(laboratory: Laboratory, value: object) -> None:
    laboratory.regulator.sensor_break = bool(value)


def _pv_offset(laboratory: Laboratory, value: object) -> None:
    laboratory.regulator.pv_offset_K = float(str(value))


def _offset_thermometer(laboratory: Laboratory, value: object) -> None:
    laboratory.thermometers.offset_K = _of_thermometers(laboratory, value)


def _stuck_thermometer(laboratory: Laboratory, value: object) -> None:
    laboratory.thermometers.stuck_degC = _of_thermometers(laboratory, value)


def _of_thermometers(laboratory: Laboratory, value: object) -> dict[int, float]:
    """`{"air": 30.0}` by the module's channel numbers."""
    named = TypeAdapter(dict[str, float]).validate_python(value or {})
    return {laboratory.spec.thermometer_channels[name]: number for name, number in named.items()}


def _silent_thermometers(laboratory: Laboratory, value: object) -> None:
    laboratory.thermometers.silent = bool(value)


def _refuse_fault_bits(laboratory: Laboratory, value: object) -> None:
    laboratory.thermometers.no_fault_bits = bool(value)


def _stuck_pv(laboratory: Laboratory, value: object) -> None:
    laboratory.regulator.stuck_pv_degC = None if value is None else float(str(value))


def _pv_drift(laboratory: Laboratory, value: object) -> None:
    laboratory.regulator.pv_drift_K_per_h = float(str(value))


def _probe_out(laboratory: Laboratory, value: object) -> None:
    laboratory.regulator.probe_out = bool(value)


def _exchange_probes(laboratory: Laboratory, value: object) -> None:
    laboratory.regulator.probe_exchanged = laboratory.thermometers.air_exchanged = bool(value)


def _pull_thermometer_out(laboratory: Laboratory, value: object) -> None:
    channels = laboratory.spec.thermometer_channels
    laboratory.thermometers.pulled_out = {channels[str(value)]} if value else set()


def _short_thermometer(laboratory: Laboratory, value: object) -> None:
    channels = laboratory.spec.thermometer_channels
    laboratory.thermometers.shorted_channels = {channels[str(value)]} if value else set()


def _drift_thermometer(laboratory: Laboratory, value: object) -> None:
    laboratory.thermometers.drift_K_per_h = _of_thermometers(laboratory, value)


def _hold_thermometer(laboratory: Laboratory, value: object) -> None:
    laboratory.thermometers.held_degC = _of_thermometers(laboratory, value)


def _press_set_point(laboratory: Laboratory, value: object) -> None:
    laboratory.regulator.press_setpoint(float(str(value)))


def _press_stop(laboratory: Laboratory, value: object) -> None:
    laboratory.regulator.press_stop()


def _press_manual(laboratory: Laboratory, value: object) -> None:
    if value is None:
        laboratory.regulator.press_automatic()
    else:
        laboratory.regulator.press_manual(float(str(value)))


def _press_autotune(laboratory: Laboratory, value: object) -> None:
    laboratory.regulator.press_autotune(bool(value))


def _cut_out(laboratory: Laboratory, value: object) -> None:
    laboratory.plant.cut_out_open = bool(value)


def _weld_ssr(laboratory: Laboratory, value: object) -> None:
    laboratory.ssr_welded_share = float(str(value or 0))


def _alarm_axis(laboratory: Laboratory, value: object) -> None:
    for name, axis in laboratory.axes.items():
        axis.alarm = name == value


def _silent_bus(laboratory: Laboratory, value: object) -> None:
    laboratory.bus_faults.silent = bool(value)


def _unplug_bus(laboratory: Laboratory, value: object) -> None:
    wire = laboratory.bus
    if not isinstance(wire, TcpWire):
        raise ValueError("only a bus behind a gateway (tcp) can be unplugged")
    if value:
        wire.close()
    else:
        wire.plug()


def _garble_bus(laboratory: Laboratory, value: object) -> None:
    laboratory.bus_faults.garbled = int(str(value))


def _late_reply(laboratory: Laboratory, value: object) -> None:
    laboratory.bus_faults.late_s = float(str(value))


def _silent_relays(laboratory: Laboratory, value: object) -> None:
    """The board does not answer for so many s of simulated time."""
    relays, plant = laboratory.relays, laboratory.plant
    until_ns = plant.now_ns + seconds_ns(float(str(value)))
    relays.silent = True

    def wait(time_ns: int, dt_s: float) -> None:
        relays.silent = relays.silent and time_ns < until_ns

    plant.on_step.append(wait)


def _brown_out(laboratory: Laboratory, value: object) -> None:
    laboratory.relays.power_cycle()


def _stop_rearming(laboratory: Laboratory, value: object) -> None:
    laboratory.relays.rearms = not value


def _stop_timing(laboratory: Laboratory, value: object) -> None:
    laboratory.relays.times = not value


def _lose_relay_writes(laboratory: Laboratory, value: object) -> None:
    laboratory.relays.lost_writes = bool(value)


def _overheat_camera(laboratory: Laboratory, value: object) -> None:
    laboratory.camera_sensor_degC = None if value is None else float(str(value))


def _flap_jam(laboratory: Laboratory, value: object) -> None:
    laboratory.flap.jam_position = None if value is None else int(str(value))


def _camera_loss(laboratory: Laboratory, value: object) -> None:
    laboratory.camera.faults.loss = float(str(value))


def _silent_camera(laboratory: Laboratory, value: object) -> None:
    laboratory.camera.faults.silent_gvcp = laboratory.camera.faults.silent_gvsp = bool(value)


def _freeze_temperature(laboratory: Laboratory, value: object) -> None:
    laboratory.camera.faults.temperature = "stuck" if value else None


def _hide_temperature(laboratory: Laboratory, value: object) -> None:
    laboratory.camera.faults.temperature = "zero" if value else None


def _restart_camera(laboratory: Laboratory, value: object) -> None:
    laboratory.camera.restart()


def _camera_without_stream(laboratory: Laboratory, value: object) -> None:
    laboratory.camera.faults.no_stream_channel = bool(value)
    if value:
        laboratory.camera.restart()


# Name -> how to break a link or a quantity; the value undoes it as None, false or 0.
FAULTS: dict[str, Callable[[Laboratory, object], None]] = {
    "thermometer.open": _open_thermometer,  # the channel's name: its wire is broken
    "regulator.sensor_break": _sensor_break,
    "regulator.pv_offset_K": _pv_offset,  # the probe reads wrong by this much
    "regulator.stuck_pv_degC": _stuck_pv,
    "regulator.pv_drift_K_per_h": _pv_drift,
    "regulator.probe_out": _probe_out,  # hangs in the laboratory
    "regulator.probe_exchanged": _exchange_probes,  # with the air's thermometer
    "thermometer.pulled_out": _pull_thermometer_out,  # the channel's name: it hangs in the laboratory
    "thermometer.shorted": _short_thermometer,  # the channel's name
    "thermometer.drift_K_per_h": _drift_thermometer,  # {channel's name: K/h}
    "thermometer.held_degC": _hold_thermometer,  # {channel's name: degC}, with the converter's noise
    "regulator.set_point_degC": _press_set_point,  # somebody changes it with the keys
    "regulator.stop_key": _press_stop,  # somebody stops control with the keys
    "regulator.manual_percent": _press_manual,  # somebody dials in a heating output; None gives control back
    "regulator.autotune": _press_autotune,  # somebody starts it with the keys, or cancels it
    "thermometer.offset_K": _offset_thermometer,  # {channel's name: K}
    "thermometer.stuck_degC": _stuck_thermometer,  # {channel's name: degC}
    "thermometers.silent": _silent_thermometers,
    "thermometers.no_fault_bits": _refuse_fault_bits,  # which makes their values STALE
    "heater.cut_out": _cut_out,  # the hard-wired thermal cut-out is open: a dead heater
    "heater.welded_share": _weld_ssr,  # share of the time its solid-state relay conducts at least
    "axis.alarm": _alarm_axis,  # the axis' name
    "bus.silent": _silent_bus,
    "bus.unplugged": _unplug_bus,  # nobody listens at the gateway's address, and its connections are cut
    "bus.garbled": _garble_bus,  # so many of the coming replies
    "bus.late_s": _late_reply,  # the next reply, by so many real seconds
    "relays.silent_s": _silent_relays,  # its timed-on relays time out and drop
    "relays.lost_writes": _lose_relay_writes,  # acknowledged, not done
    "relays.brown_out": _brown_out,  # off and on again: every relay is open
    "relays.no_rearm": _stop_rearming,  # a timed-on that runs does not start its time again
    "relays.no_timer": _stop_timing,  # a timed-on stays on
    "flap.jam": _flap_jam,  # feedback counts at which it stops
    "camera.sensor_degC": _overheat_camera,  # its sensor chip stays at this
    "camera.restart": _restart_camera,  # by itself, its supply on all the while
    "camera.no_stream_channel": _camera_without_stream,  # it restarts, and does not offer one until this is undone
    "camera.frozen_temperature": _freeze_temperature,  # it keeps showing the last one
    "camera.no_temperature": _hide_temperature,  # it shows 0 degC
    "camera.loss": _camera_loss,  # share of stream packets lost
    "camera.silent": _silent_camera,  # neither answers nor sends
}
