"""One simulated laboratory: the plant and every fake device on its wire; laboratory_faults.py breaks it."""

from __future__ import annotations

import secrets
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from thermostand.drivers.sim.fakes import FakeDevice, added_fake
from thermostand.drivers.sim.faults import LinkFaults
from thermostand.drivers.sim.gige.camera import FakeCamera
from thermostand.drivers.sim.gige.genicam_file import read_genicam
from thermostand.drivers.sim.gige.switch import Switch
from thermostand.drivers.sim.laboratory_spec import ChamberUnitSpec, LaboratorySpec
from thermostand.drivers.sim.link_faults import Link
from thermostand.drivers.sim.motion.flap import FakeFlap
from thermostand.drivers.sim.motion.ximc import FakeAxis
from thermostand.drivers.sim.physics.optics import CameraKind, true_centres_px
from thermostand.drivers.sim.physics.plant import Plant, PlantSpec, STEP_s
from thermostand.drivers.sim.physics.published_camera import PublishedCamera
from thermostand.drivers.sim.physics.scene import Scene, SceneSpec, still
from thermostand.drivers.sim.units.adam_4015 import FakeAdam4015
from thermostand.drivers.sim.units.climate_chambers import FakeClimateChamber, FakeCts, FakeEspec, FakeWeiss
from thermostand.drivers.sim.units.heat_module import FakeHeatModule
from thermostand.drivers.sim.units.julabo_circulator import FakeJulabo
from thermostand.drivers.sim.units.modbus import RtuEngine, TcpEngine, Unit
from thermostand.drivers.sim.units.probes import FakeProbe
from thermostand.drivers.sim.units.regulator import FakeRegulator
from thermostand.drivers.sim.units.relays import FakeRelays
from thermostand.drivers.sim.units.rtd_sensors import CHANNELS
from thermostand.drivers.sim.units.simserv_chamber import FakeSimserv
from thermostand.drivers.sim.units.thermal_imager import FakeThermalImager
from thermostand.drivers.sim.units.thermometers import FakeThermometers
from thermostand.drivers.sim.usb import UsbServer
from thermostand.drivers.sim.wire import Engine, PtyWire, TcpWire
from thermostand.foundation.addresses import tcp_place
from thermostand.foundation.clock import FollowedClock, WallClock
from thermostand.foundation.errors import ConfigError

# How fast frames leave: as a camera's readout in real time; in virtual time nothing else moves meanwhile.
_PACE_MBps = {False: 40.0, True: 120.0}

_LINE_MBps = 125.0  # 1 Gbit/s, at which each of several cameras sends unless it is set to pause
_FREE_ADDRESS_TRIES = 100


Found = TypeVar("Found")


def _there(found: Found | None, what: str) -> Found:
    if found is None:
        raise ValueError(f"this laboratory has no {what}")
    return found


class Laboratory:
    """Everything, running; `advance` moves virtual time, in real time the plant follows the host's clock.

    addresses: where each of bus, flap, camera and the axes answers, written as in a stand's configuration.
    """

    def __init__(self, spec: LaboratorySpec) -> None:
        self.spec = spec
        self._followed = FollowedClock(spec.start_ns) if spec.virtual else None
        self._clock = self._followed or WallClock()
        kinds = {camera.optics or spec.camera_kind for camera in spec.cameras.values()} or {spec.camera_kind}
        plant_spec = PlantSpec(
            camera="unmodified" if "unmodified" in kinds else "modified",
            seed=spec.seed,
            laboratory_degC=spec.laboratory_degC,
            chamber_seed=spec.chamber_seed,
            camera_powered=spec.relays_unit is None,
        )
        self.plant = Plant(plant_spec, self._clock.now_ns())
        self.axes: dict[str, FakeAxis] = {}
        self.probes: dict[str, FakeProbe] = {}
        self.devices: dict[str, FakeDevice] = {}
        self.thermometer_modules: list[FakeThermometers | FakeAdam4015] = []
        self.cameras: dict[str, FakeCamera] = {}
        self.published: dict[str, PublishedCamera] = {}
        self.addresses: dict[str, str] = {}
        self._links: dict[str, Link] = {}
        self._regulator: FakeRegulator | None = None
        self._relays: FakeRelays | None = None
        self._heat_module: FakeHeatModule | None = None
        self._chamber: FakeClimateChamber | None = None
        self._imager: FakeThermalImager | None = None
        self._flap: FakeFlap | None = None
        self.switch: Switch | None = None
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
        except ValueError as error:
            self.close()
            raise ConfigError(f"laboratory: {error}") from error
        except BaseException:
            self.close()
            raise

    @property
    def camera(self) -> FakeCamera:
        """The camera that is named so, or the first; ValueError when there is none."""
        if not self.cameras:
            raise ValueError("this laboratory has no camera")
        return self.cameras.get("camera") or next(iter(self.cameras.values()))

    @property
    def regulator(self) -> FakeRegulator:
        """The regulator on the bus; ValueError when there is none."""
        return _there(self._regulator, "regulator on its bus")

    @property
    def relays(self) -> FakeRelays:
        """The relay board; ValueError when there is none."""
        return _there(self._relays, "relay board")

    @property
    def heat_module(self) -> FakeHeatModule:
        """The analog output that heats; ValueError when there is none."""
        return _there(self._heat_module, "analog output")

    @property
    def chamber(self) -> FakeClimateChamber:
        """The climate chamber with a controller of its own; ValueError when there is none."""
        return _there(self._chamber, "climate chamber of its own")

    @property
    def imager(self) -> FakeThermalImager:
        """The thermal imager; ValueError when there is none."""
        return _there(self._imager, "thermal imager")

    @property
    def flap(self) -> FakeFlap:
        """The flap; ValueError when there is none."""
        return _there(self._flap, "flap")

    @property
    def now_ns(self) -> int:
        """The laboratory's time."""
        return self._clock.now_ns()

    @property
    def is_virtual(self) -> bool:
        """Whether its time moves by `advance` alone."""
        return self._followed is not None

    def link(self, name: str) -> Link:
        """The wire of the bus or an axis; ValueError when there is none."""
        if name not in self._links:
            raise ValueError(f"this laboratory has no {name}")
        return self._links[name]

    def axis(self, name: str) -> FakeAxis:
        """One axis of the table; ValueError when there is none."""
        if name not in self.axes:
            raise ValueError(f"this laboratory has no {name}")
        return self.axes[name]

    def advance(self, now_ns: int) -> None:
        """Virtual time moves to `now_ns`; ValueError in real time or backwards."""
        if self._followed is None:
            raise ValueError("this laboratory runs in real time")
        with self.plant.lock:
            self._followed.follow(now_ns)
            self.plant.advance(now_ns)
        for camera in self.cameras.values():
            camera.advance(now_ns)

    def state(self) -> dict[str, float]:
        """The plant's true state now; `now_ns` is the laboratory's time. The flap is faster than the plant's grid."""
        with self.plant.lock:
            now_ns = self._clock.now_ns()
            self.plant.advance(now_ns)
            return {"now_ns": now_ns, **self.plant.state(), "flap_open": self.plant.flap_open_at(now_ns)}

    def true_centres_px(self) -> list[list[float]]:
        """Noise-free marker centres (x, y) as the camera named so, or the first, sees them; marker 1 first."""
        with self.plant.lock:
            now_ns = self._clock.now_ns()
            self.plant.advance(now_ns)
            leading = "camera" if "camera" in self.spec.cameras else next(iter(self.spec.cameras), "")
            return true_centres_px(self.plant.optics(now_ns, self._optics_of(leading))).tolist()

    def close(self) -> None:
        """Take everything down, last built first."""
        while self._closers:
            self._closers.pop()()

    def _build(self) -> None:
        spec, plant, clock = self.spec, self.plant, self._clock
        units: list[Unit] = []
        if spec.regulator_unit is not None:
            self._regulator = FakeRegulator(plant, clock, spec.regulator_unit)
            units.append(self._regulator)
        if spec.chamber is not None:
            self._chamber = self._climate_chamber(spec.chamber)
            self._listen("regulator", spec.chamber.address, self._chamber.engine)
        if spec.relays_unit is not None:
            self._relays = FakeRelays(plant, clock, spec.relays_unit, spec.relay_channels)
            units.append(self._relays)
        if spec.heat_module_unit is not None:
            self._heat_module = FakeHeatModule(plant, clock, spec.heat_module_unit, spec.heat_module_output)
            units.append(self._heat_module)
        plant.on_step.append(self._conduct)  # after the regulator's and the relays'
        units += self._rtd_modules()
        self.inputs: FakeRelays | None = self._relays  # a board that has both
        if spec.inputs_unit not in (None, spec.relays_unit):
            self.inputs = FakeRelays(plant, clock, spec.inputs_unit, {})
            units.append(self.inputs)
        if spec.inputs_unit is not None and self.inputs is not None:
            self.inputs.closed_inputs = set(spec.inputs_closed)
        framing = RtuEngine if spec.bus.startswith("serial:") else TcpEngine
        self._listen("bus", spec.bus, lambda: framing(units))
        for name, probe in spec.probes.items():
            self.probes[name] = FakeProbe(plant, clock, probe.protocol, probe.serial_number or "P-1", spec.seed)
            self._listen(name, probe.address, self.probes[name].engine)
        for name, settings in spec.devices.items():
            self.devices[name] = added_fake(str(settings["kind"]))(plant, clock, settings, spec.seed)
            self._listen(name, str(settings["address"]), self.devices[name].engine)
        for name, settings in spec.axes.items():
            axis = FakeAxis(plant, clock, settings.stage, settings.serial_number, name)
            self.axes[str(name)] = axis
            self._listen(name, settings.address, axis.engine)
        if spec.flap is not None:
            self._flap = FakeFlap(plant, clock, spec.flap.serial_number or "")
            usb = UsbServer(*tcp_place(spec.flap.address or "", may_be_free=True), [self._flap])
            self._closers.append(usb.close)
            self.addresses["flap"] = usb.address
        if spec.imager is not None:
            self._imager = FakeThermalImager(plant, spec.imager.folder, spec.imager.spots, spec.seed)
            self._closers.append(self._imager.close)
            self.addresses["imager"] = str(self._imager.folder)
        self._publish()
        for name in spec.cameras:
            seed = spec.seed + (zlib.crc32(name.encode()) if self.cameras else 0)  # two that expose together differ
            camera = self._camera(name, Scene(SceneSpec(), seed))
            self._closers.append(camera.close)
            camera.start()
            self.cameras[name], self.addresses[name] = camera, camera.address
        self._share_a_switch()

    def _publish(self) -> None:
        """The cameras with physics of their own; one with a far thermometer of the air has the stand's hang there."""
        for name, spec in self.spec.cameras.items():
            if spec.preset is None:
                continue
            seed = f"{self.spec.seed} {name}"
            camera = PublishedCamera(spec.preset, self.plant, STEP_s, spec.effects, spec.drawn, seed)
            self.published[name] = camera
            self.plant.on_step.append(camera.step)
            if "far_air" in spec.effects:
                for module in self.thermometer_modules:
                    module.far_air_degC = lambda camera=camera: camera.far_air_degC

    def _optics_of(self, name: str) -> CameraKind | PublishedCamera:
        """What the camera of this name is."""
        spec = self.spec.cameras.get(name)
        kind = self.spec.camera_kind if spec is None else spec.optics or self.spec.camera_kind
        return self.published.get(name, kind)

    def _rtd_modules(self) -> list[Unit]:
        spec, make = self.spec, FakeAdam4015 if self.spec.thermometers_model == "adam4015" else FakeThermometers
        for number, unit in enumerate(spec.thermometers_units):
            first = number * CHANNELS
            here = {name: at for name, at in spec.thermometer_channels.items() if first <= at < first + CHANNELS}
            self.thermometer_modules.append(make(self.plant, self._clock, unit, here, spec.seed, first))
        return list(self.thermometer_modules)

    @property
    def thermometers(self) -> FakeThermometers:
        """The first module; ValueError when it is of another make."""
        first = self.thermometer_modules[0]
        if not isinstance(first, FakeThermometers):
            raise ValueError("this laboratory has an ADAM-4015")
        return first

    def _share_a_switch(self) -> None:
        """Between several cameras and the computer; in virtual time they take turns, and need none."""
        if not self.is_virtual and len(self.cameras) > 1:
            self.switch = Switch(_LINE_MBps)
            for camera in self.cameras.values():
                camera.faults.switch = self.switch

    def _climate_chamber(self, spec: ChamberUnitSpec) -> FakeClimateChamber:
        is_serial = spec.address.startswith("serial:")
        match spec.protocol:
            case "espec":
                chamber: FakeClimateChamber = FakeEspec(self.plant, self._clock)
            case "cts":
                chamber = FakeCts(self.plant, self._clock, spec.unit, is_serial=is_serial)
            case "ascii2":
                chamber = FakeWeiss(self.plant, self._clock, spec.unit)
            case "simserv":
                chamber = FakeSimserv(self.plant, self._clock, spec.unit)
            case "julabo":
                chamber = FakeJulabo(self.plant, self._clock)
        chamber.is_alone = self.spec.relays_unit is None
        chamber.limits_degC = spec.limits_degC or chamber.limits_degC
        return chamber

    def _camera(self, name: str, scene: Scene) -> FakeCamera:
        """At its address, or at a free one: GVCP's port is fixed, but any of 127.0.0.0/8 will do."""
        settings = self.spec.cameras[name]
        genicam = read_genicam(settings.genicam) if settings.genicam is not None else None
        kind = self._optics_of(name)
        picture = still(scene.render) if settings.still else scene.render

        def render(time_ns: int, exposure_s: float, gain_dB: float, rows: int) -> NDArray[np.uint8]:
            with self.plant.lock:
                self.plant.advance(time_ns if self._followed is None else self._clock.now_ns())
                optics = self.plant.optics(time_ns, kind)
                flap_open = 1.0 if self._flap is None else self.plant.flap_open_at(time_ns)  # else a window
            return picture(optics, time_ns, exposure_s, gain_dB, flap_open, rows)

        def at(address: str) -> FakeCamera:
            return FakeCamera(
                self.plant,
                self._clock,
                render,
                address,
                settings.serial_number or "",
                real_time=not self.spec.virtual,
                warms_up=not self.spec.virtual and self._flap is None,  # a shut flap's warms nothing
                pace_MBps=_PACE_MBps[self.spec.virtual] if len(self.spec.cameras) < 2 else _LINE_MBps,
                boot_s=self.spec.camera_boot_s,
                genicam=genicam,
                thermometers=self.published.get(name),
            )

        return at(settings.address) if settings.address else _at_a_free_address(at)

    def _conduct(self, time_ns: int, dt_s: float) -> None:
        """A welded solid-state relay conducts regardless of the regulator; a camera without cooling stays hot."""
        self.plant.heater_on_fraction = max(self.plant.heater_on_fraction, self.ssr_welded_share)
        if self.camera_sensor_degC is not None:
            self.plant.sensor_degC = self.camera_sensor_degC
        for camera in self.published.values():
            camera.held_chip_degC = self.camera_sensor_degC

    def _listen(self, name: str, address: str, make_engine: Callable[[], Engine]) -> None:
        faults = LinkFaults(seed=self.spec.seed)
        if address.startswith("serial:"):
            path = address.removeprefix("serial:")
            wire: PtyWire | TcpWire = PtyWire(Path(path) if path else None, make_engine(), faults)
        else:
            wire = TcpWire(*tcp_place(address, may_be_free=True), make_engine, faults)
        self._closers.append(wire.close)
        self.addresses[name] = wire.address
        self._links[name] = Link(wire, faults)


def _at_a_free_address(at: Callable[[str], FakeCamera]) -> FakeCamera:
    number, tries_left = secrets.SystemRandom(), _FREE_ADDRESS_TRIES
    while True:
        address = f"127.{number.randrange(64, 255)}.{number.randrange(256)}.{number.randrange(1, 255)}"
        try:
            return at(address)
        except OSError:
            tries_left -= 1
            if not tries_left:
                raise
