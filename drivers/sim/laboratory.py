"""One simulated laboratory: the plant, every fake device on its wire, and the faults that can be injected."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter

from drivers.clock import FollowedClock, WallClock, seconds_ns
from drivers.documents import Document
from drivers.interface import ConfigError
from drivers.sim.camera import FakeCamera
from drivers.sim.faults import LinkFaults
from drivers.sim.flap import FakeFlap
from drivers.sim.modbus import RtuEngine, TcpEngine
from drivers.sim.optics import true_centres_px
from drivers.sim.plant import Plant, PlantSpec
from drivers.sim.regulator import FakeRegulator
from drivers.sim.relays import FakeRelays
from drivers.sim.scene import Scene, SceneSpec
from drivers.sim.thermometers import FakeThermometers
from drivers.sim.usb import UsbServer
from drivers.sim.wire import Engine, PtyWire, TcpWire
from drivers.sim.ximc import FakeAxis
from drivers.sim.ximc_table import LINEAR_8MT160_300, ROTARY_8MR151

PROFILES = {"8MT160-300": LINEAR_8MT160_300, "8MR151": ROTARY_8MR151}

# How fast frames leave: as a camera's readout in real time; in virtual time nothing else moves meanwhile.
_PACE_MBps = {False: 40.0, True: 120.0}

_FREE_ADDRESS_TRIES = 100


class AxisSpec(Document):
    """A stage: where its controller answers and which profile it was delivered with."""

    address: str
    profile: Literal["8MT160-300", "8MR151"]
    serial_number: int


class EndpointSpec(Document):
    """A device with an address and a serial number."""

    address: str | None
    serial_number: str | None


class LaboratorySpec(Document):
    """What the simulator process is told on its standard input.

    Port 0, "serial:" without a path and a camera without an address stand for free ones.
    """

    virtual: bool
    control: str
    start_ns: int = Field(ge=0)
    seed: int
    camera_kind: Literal["modified", "unmodified"]
    laboratory_degC: float
    chamber_seed: int | None = None
    bus: str
    regulator_unit: int
    relays_unit: int
    relay_channels: dict[str, int]
    thermometers_unit: int
    thermometer_channels: dict[str, int]
    axes: dict[Literal["linear", "rotary"], AxisSpec]
    flap: EndpointSpec
    camera: EndpointSpec


class Laboratory:
    """Everything, running; `advance` moves virtual time, in real time the plant follows the host's clock.

    addresses: where each of bus, flap, camera and the axes answers, written as in a stand's configuration.
    """

    def __init__(self, spec: LaboratorySpec) -> None:
        self.spec = spec
        self._followed = FollowedClock(spec.start_ns) if spec.virtual else None
        self._clock = self._followed or WallClock()
        plant_spec = PlantSpec(
            camera=spec.camera_kind,
            seed=spec.seed,
            laboratory_degC=spec.laboratory_degC,
            chamber_seed=spec.chamber_seed,
        )
        self.plant = Plant(plant_spec, self._clock.now_ns())
        self._scene = Scene(SceneSpec(), spec.seed)
        self.axes: dict[str, FakeAxis] = {}
        self.addresses: dict[str, str] = {}
        self.ssr_welded_share = 0.0
        self.camera_sensor_degC: float | None = None
        self._closers: list[Callable[[], None]] = []
        try:
            self._build()
        except OSError as error:
            self.close()
            raise ConfigError(
                f"an address of the simulated laboratory cannot be used; is one running already? ({error})"
            ) from error
        except BaseException:
            self.close()
            raise

    def advance(self, now_ns: int) -> None:
        """Virtual time moves to `now_ns`; ValueError in real time or backwards."""
        if self._followed is None:
            raise ValueError("this laboratory runs in real time")
        with self.plant.lock:
            self._followed.follow(now_ns)
            self.plant.advance(now_ns)
        self.camera.advance(now_ns)

    def state(self) -> dict[str, float]:
        """The plant's true state now; `now_ns` is the laboratory's time."""
        with self.plant.lock:
            now_ns = self._clock.now_ns()
            self.plant.advance(now_ns)
            return {"now_ns": now_ns, **self.plant.state()}

    def true_centres_px(self) -> list[list[float]]:
        """Noise-free marker centres (x, y), marker 1 first."""
        with self.plant.lock:
            now_ns = self._clock.now_ns()
            self.plant.advance(now_ns)
            return true_centres_px(self.plant.optics(now_ns)).tolist()

    def inject(self, name: str, value: object) -> None:
        """Set one of FAULTS; `value` as the fault's own attribute takes it."""
        with self.plant.lock:
            FAULTS[name](self, value)

    def close(self) -> None:
        """Take everything down, last built first."""
        while self._closers:
            self._closers.pop()()

    def _build(self) -> None:
        spec, plant, clock = self.spec, self.plant, self._clock
        self.regulator = FakeRegulator(plant, clock, spec.regulator_unit)
        plant.on_step.append(self._conduct)  # after the regulator's
        self.relays = FakeRelays(plant, clock, spec.relays_unit, spec.relay_channels)
        self.thermometers = FakeThermometers(
            plant, clock, spec.thermometers_unit, spec.thermometer_channels, seed=spec.seed
        )
        units = (self.regulator, self.relays, self.thermometers)
        framing = RtuEngine if spec.bus.startswith("serial:") else TcpEngine
        self.bus_faults = self._listen("bus", spec.bus, lambda: framing(units))
        for name, settings in spec.axes.items():
            axis = FakeAxis(plant, clock, PROFILES[settings.profile], settings.serial_number, name)
            self.axes[str(name)] = axis
            self._listen(name, settings.address, axis.engine)
        self.flap = FakeFlap(plant, clock, spec.flap.serial_number or "")
        usb = UsbServer(*_host_and_port(spec.flap.address or ""), [self.flap])
        self._closers.append(usb.close)
        self.camera = self._camera_at(spec.camera.address) if spec.camera.address else self._camera_at_a_free_address()
        self._closers.append(self.camera.close)
        self.camera.start()
        self.addresses |= {"flap": usb.address, "camera": self.camera.address}

    def _camera_at(self, address: str) -> FakeCamera:
        spec = self.spec
        return FakeCamera(
            self.plant,
            self._clock,
            self._render,
            address,
            spec.camera.serial_number or "",
            real_time=not spec.virtual,
            pace_MBps=_PACE_MBps[spec.virtual],
        )

    def _camera_at_a_free_address(self) -> FakeCamera:
        """GVCP's port is fixed, so cameras side by side need addresses of their own: any of 127.0.0.0/8 will do."""
        number, tries_left = secrets.SystemRandom(), _FREE_ADDRESS_TRIES
        while True:
            address = f"127.{number.randrange(64, 255)}.{number.randrange(256)}.{number.randrange(1, 255)}"
            try:
                return self._camera_at(address)
            except OSError:
                tries_left -= 1
                if not tries_left:
                    raise

    def _conduct(self, time_ns: int, dt_s: float) -> None:
        """A welded solid-state relay conducts whatever the regulator says; a camera without cooling stays hot."""
        self.plant.heater_on_fraction = max(self.plant.heater_on_fraction, self.ssr_welded_share)
        if self.camera_sensor_degC is not None:
            self.plant.sensor_degC = self.camera_sensor_degC

    def _listen(self, name: str, address: str, make_engine: Callable[[], Engine]) -> LinkFaults:
        faults = LinkFaults(seed=self.spec.seed)
        if address.startswith("serial:"):
            path = address.removeprefix("serial:")
            wire: PtyWire | TcpWire = PtyWire(Path(path) if path else None, make_engine(), faults)
        else:
            wire = TcpWire(*_host_and_port(address), make_engine, faults)
        self._closers.append(wire.close)
        self.addresses[name] = wire.address
        return faults

    def _render(self, time_ns: int, exposure_s: float, gain_dB: float) -> NDArray[np.uint8]:
        with self.plant.lock:
            self.plant.advance(time_ns if self._followed is None else self._clock.now_ns())
            optics, flap_open = self.plant.optics(time_ns), self.plant.flap_open_at(time_ns)
        return self._scene.render(optics, time_ns, exposure_s, gain_dB, flap_open)


def _host_and_port(address: str) -> tuple[str, int]:
    kind, _, place = address.partition(":")
    host, _, port = place.rpartition(":")
    if kind != "tcp" or not port.isdigit():
        raise ConfigError(f"laboratory: expected tcp:HOST:PORT, not {address!r}")
    return host, int(port)


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


def _hide_temperature(laboratory: Laboratory, value: object) -> None:
    laboratory.camera.faults.temperature = "zero" if value else None


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
    "bus.garbled": _garble_bus,  # so many of the coming replies
    "bus.late_s": _late_reply,  # the next reply, by so many real seconds
    "relays.silent_s": _silent_relays,  # its timed-on relays go on and drop
    "relays.lost_writes": _lose_relay_writes,  # acknowledged, not done
    "relays.brown_out": _brown_out,  # off and on again: every relay is open
    "relays.no_rearm": _stop_rearming,  # a timed-on that runs does not start its time again
    "relays.no_timer": _stop_timing,  # a timed-on stays on
    "flap.jam": _flap_jam,  # feedback counts at which it stops
    "camera.sensor_degC": _overheat_camera,  # its sensor chip stays at this
    "camera.no_stream_channel": _camera_without_stream,  # it restarts, and does not offer one until this is undone
    "camera.no_temperature": _hide_temperature,  # it shows 0 degC
    "camera.loss": _camera_loss,  # share of stream packets lost
    "camera.silent": _silent_camera,  # neither answers nor sends
}
