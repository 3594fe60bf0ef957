"""One simulated laboratory: the plant and every fake device on its wire; laboratory_faults.py breaks it."""

from __future__ import annotations

import secrets
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from thermostand.drivers.camera_preset import CameraPreset, Effect
from thermostand.drivers.sim.fakes import (
    CAMERAS,
    CONTACTS,
    CONTROL,
    MEASURE,
    OUTPUT,
    OWN_LINE,
    PICTURES,
    Bench,
    Fake,
    fake,
    get_fake,
)
from thermostand.drivers.sim.gige.camera import FakeCamera
from thermostand.drivers.sim.gige.genicam_file import read_genicam
from thermostand.drivers.sim.gige.gvsp_sender import Switch
from thermostand.drivers.sim.motion.flap import FakeFlap
from thermostand.drivers.sim.motion.ximc import FakeAxis
from thermostand.drivers.sim.physics.optics import CameraKind, compute_true_centres_px
from thermostand.drivers.sim.physics.plant import Plant, PlantSpec, STEP_s
from thermostand.drivers.sim.physics.published_camera import PublishedCamera
from thermostand.drivers.sim.physics.scene import SceneSpec, SimulatedScene, make_still
from thermostand.drivers.sim.units.climate_chambers import FakeClimateChamber
from thermostand.drivers.sim.units.heat_module import FakeHeatModule
from thermostand.drivers.sim.units.modbus import RtuEngine, TcpEngine, Unit
from thermostand.drivers.sim.units.regulator import FakeRegulator
from thermostand.drivers.sim.units.relays import FakeRelays
from thermostand.drivers.sim.units.thermal_imager import FakeThermalImager
from thermostand.drivers.sim.units.thermometers import FakeThermometers, RtdModule
from thermostand.drivers.sim.units.ups import FakeUps
from thermostand.drivers.sim.wire import Engine, FaultyLink, LinkFaults, PtyWire, TcpWire
from thermostand.foundation.addresses import parse_tcp_address
from thermostand.foundation.clock import FollowedClock, WallClock
from thermostand.foundation.documents import Document
from thermostand.foundation.errors import ConfigError

# What the simulator process reads on its standard input: which fakes there are, and where each answers.


class CameraSpec(Document):
    """A camera; optics: none is as `camera_kind`. preset: the camera's own physics instead, with these effects, and its
    number where it is drawn. genicam: the file of another make, which it then shows. still: it
    renders a picture once and shows it from then on, for measurements of time on the machine that simulates."""

    address: str | None
    serial_number: str | None
    optics: CameraKind | None = None
    preset: CameraPreset | None = None
    effects: tuple[Effect, ...] = ()
    drawn: int | None = None
    genicam: Path | None = None
    still: bool = False


class DeviceSpec(Document):
    """A device. fake: its key in drivers.sim.fakes. settings: as the stand's file has them, and what its fake needs to
    know of the rest of that file."""

    fake: str
    settings: dict[str, Any]


class LaboratorySpec(Document):
    """What the simulator process reads on its standard input.

    Port 0, "serial:" without a path and a camera without an address stand for free ones. All cameras see the same.
    """

    virtual: bool
    control: str
    start_ns: int = Field(ge=0)
    seed: int
    camera_kind: CameraKind
    laboratory_degC: float
    chamber_seed: int | None = None
    bus: str
    devices: dict[str, DeviceSpec]
    camera_boot_s: float = Field(default=3.0, ge=0)
    faults: tuple[str, ...] = ()

    @property
    def cameras(self) -> dict[str, CameraSpec]:
        """The specifications of the cameras, by name."""
        return {
            name: CameraSpec.model_validate(each.settings)
            for name, each in self.devices.items()
            if each.fake == "cameras"
        }


# How fast frames leave: as a camera's readout in real time; in virtual time nothing else moves meanwhile.
_PACE_MBps = {False: 40.0, True: 120.0}

_LINE_MBps = 125.0  # 1 Gbit/s, at which each of several cameras sends unless it is set to pause
_FREE_ADDRESS_TRIES = 100


Found = TypeVar("Found")


class Laboratory:
    """Everything, running; `advance` moves virtual time, in real time the plant follows the host's clock.

    addresses: where each of bus, flap, camera and the axes answers, written as in a stand's configuration.
    """

    def __init__(self, spec: LaboratorySpec) -> None:
        self.spec = spec
        self.seed = spec.seed
        self.has_relays = "relays" in spec.devices
        self._followed = FollowedClock(spec.start_ns) if spec.virtual else None
        self.clock = self._followed or WallClock()
        self._cameras = spec.cameras
        kinds = {camera.optics or spec.camera_kind for camera in self._cameras.values()} or {spec.camera_kind}
        plant_spec = PlantSpec(
            camera="unmodified" if "unmodified" in kinds else "modified",
            seed=spec.seed,
            laboratory_degC=spec.laboratory_degC,
            chamber_seed=spec.chamber_seed,
            camera_powered=not self.has_relays,
        )
        self.plant = Plant(plant_spec, self.clock.now_ns())
        self.fakes: dict[str, object] = {}
        self.published: dict[str, PublishedCamera] = {}
        self.addresses: dict[str, str] = {}
        self._links: dict[str, FaultyLink] = {}
        self._units: list[Unit] = []
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
    def cameras(self) -> dict[str, FakeCamera]:
        """The fake cameras, by name."""
        return {name: each for name, each in self.fakes.items() if isinstance(each, FakeCamera)}

    @property
    def axes(self) -> dict[str, FakeAxis]:
        """The axes of the table, by name."""
        return {name: each for name, each in self.fakes.items() if isinstance(each, FakeAxis)}

    @property
    def camera(self) -> FakeCamera:
        """The camera that is named so, or the first; ValueError when there is none."""
        cameras = self.cameras
        if not cameras:
            raise ValueError("this laboratory has no camera")
        return cameras.get("camera") or next(iter(cameras.values()))

    @property
    def regulator(self) -> FakeRegulator:
        """The regulator on the bus; ValueError when there is none."""
        return self._find_first(FakeRegulator, "regulator on its bus")

    @property
    def relays(self) -> FakeRelays:
        """The relay board; ValueError when there is none."""
        return self._find_first(FakeRelays, "relay board")

    @property
    def inputs(self) -> FakeRelays | None:
        """The board with the contacts."""
        found = self.fakes.get("inputs")
        return found if isinstance(found, FakeRelays) else None

    @property
    def heat_module(self) -> FakeHeatModule:
        """The analog output that heats; ValueError when there is none."""
        return self._find_first(FakeHeatModule, "analog output")

    @property
    def chamber(self) -> FakeClimateChamber:
        """The climate chamber with a controller of its own; ValueError when there is none."""
        return self._find_first(FakeClimateChamber, "climate chamber of its own")

    @property
    def imager(self) -> FakeThermalImager:
        """The thermal imager; ValueError when there is none."""
        return self._find_first(FakeThermalImager, "thermal imager")

    @property
    def flap(self) -> FakeFlap:
        """The flap; ValueError when there is none."""
        return self._find_first(FakeFlap, "flap")

    @property
    def ups(self) -> FakeUps:
        """The UPS; ValueError when there is none."""
        return self._find_first(FakeUps, "UPS")

    @property
    def thermometer_modules(self) -> tuple[RtdModule, ...]:
        """The modules of contact thermometers."""
        return cast("tuple[RtdModule, ...]", self.fakes["thermometers"])

    @property
    def thermometers(self) -> FakeThermometers:
        """The first module; ValueError when it is of another make."""
        first = self.thermometer_modules[0]
        if not isinstance(first, FakeThermometers):
            raise ValueError("this laboratory has an ADAM-4015")
        return first

    def _find_first(self, kind: type[Found], what: str) -> Found:
        """The first of its kind."""
        found = next((each for each in self.fakes.values() if isinstance(each, kind)), None)
        if found is None:
            raise ValueError(f"this laboratory has no {what}")
        return found

    @property
    def now_ns(self) -> int:
        """The laboratory's time."""
        return self.clock.now_ns()

    @property
    def is_virtual(self) -> bool:
        """Whether its time moves by `advance` alone."""
        return self._followed is not None

    @property
    def links(self) -> dict[str, FaultyLink]:
        """The wires of the bus and of the devices that have one of their own, by name; chamber: also a regulator's."""
        alias = {"chamber": self._links["regulator"]} if "regulator" in self._links else {}
        return alias | self._links

    def link(self, name: str) -> FaultyLink:
        """One of them; ValueError when there is none."""
        if name not in self.links:
            raise ValueError(f"this laboratory has no {name}")
        return self.links[name]

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

    def settle(self) -> None:
        """Return when everything that has arrived on any wire is answered, or late on purpose."""
        for link in self._links.values():
            link.wire.settle()

    def state(self) -> dict[str, float]:
        """The plant's true state now; `now_ns` is the laboratory's time. The flap is faster than the plant's grid."""
        with self.plant.at(self.clock) as now_ns:
            return {"now_ns": now_ns, **self.plant.state(), "flap_open": self.plant.flap_open_at(now_ns)}

    def compute_true_centres_px(self) -> list[list[float]]:
        """Noise-free marker centres (x, y) as the camera named so, or the first, sees them; marker 1 first."""
        with self.plant.at(self.clock) as now_ns:
            leading = "camera" if "camera" in self._cameras else next(iter(self._cameras), "")
            return compute_true_centres_px(self.plant.optics(now_ns, self._optics_of(leading))).tolist()

    def close(self) -> None:
        """Take everything down, last built first."""
        while self._closers:
            self._closers.pop()()

    def on_bus(self, unit: Unit) -> None:
        """It answers on the Modbus line."""
        self._units.append(unit)

    def listen(self, name: str, address: str, make_engine: Callable[[], Engine]) -> None:
        """A wire of its own at that address, with a new engine for each conversation."""
        faults = LinkFaults(seed=self.spec.seed)
        if address.startswith("serial:"):
            path = address.removeprefix("serial:")
            wire: PtyWire | TcpWire = PtyWire(Path(path) if path else None, make_engine(), faults)
        else:
            wire = TcpWire(*parse_tcp_address(address, may_be_free=True), make_engine, faults)
        self._links[name] = FaultyLink(wire, faults)
        self.register_address(name, wire.address, wire.close)

    def register_address(self, name: str, address: str, close: Callable[[], None]) -> None:
        """It answers there, by means of its own."""
        self._closers.append(close)
        self.addresses[name] = address

    def _build(self) -> None:
        """Build the devices in the order of their ranks: what acts on the plant, in the order in which it acts; what
        shares the bus; what has a line of its own."""
        ranked = {name: get_fake(each.fake) for name, each in self.spec.devices.items()}
        self._build_those(ranked, CONTROL, OUTPUT)
        self.plant.on_step.append(self._conduct)  # after the regulator's and the relays'
        self._build_those(ranked, MEASURE, CONTACTS)
        framing = RtuEngine if self.spec.bus.startswith("serial:") else TcpEngine
        self.listen("bus", self.spec.bus, lambda: framing(self._units))
        self._build_those(ranked, OWN_LINE, PICTURES)
        self._publish()
        self._build_those(ranked, CAMERAS, CAMERAS)
        self._share_a_switch()

    def _build_those(self, ranked: Mapping[str, Fake], first: int, last: int) -> None:
        for name, each in sorted(ranked.items(), key=lambda item: item[1].rank):
            if first <= each.rank <= last:
                self.fakes[name] = each.build(self, name, self.spec.devices[name].settings)

    def _publish(self) -> None:
        """The cameras with physics of their own; one with a far thermometer of the air has the stand's hang there."""
        for name, spec in self._cameras.items():
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
        """Return what the camera of this name is."""
        spec = self._cameras.get(name)
        kind = self.spec.camera_kind if spec is None else spec.optics or self.spec.camera_kind
        return self.published.get(name, kind)

    def camera_at(self, name: str) -> FakeCamera:
        """A new one at its address, or at a free one: GVCP's port is fixed, but any of 127.0.0.0/8 will do."""
        settings = self._cameras[name]
        seed = self.seed + (zlib.crc32(name.encode()) if self.cameras else 0)  # two that expose together differ
        scene = SimulatedScene(SceneSpec(), seed)
        genicam = read_genicam(settings.genicam) if settings.genicam is not None else None
        kind, has_flap = self._optics_of(name), "flap" in self.fakes
        picture = make_still(scene.render) if settings.still else scene.render

        def render(time_ns: int, exposure_s: float, gain_dB: float, rows: int) -> NDArray[np.uint8]:
            with self.plant.lock:
                self.plant.advance(time_ns if self._followed is None else self.clock.now_ns())
                optics = self.plant.optics(time_ns, kind)
                flap_open = 1.0 if not has_flap else self.plant.flap_open_at(time_ns)  # else a window
            return picture(optics, time_ns, exposure_s, gain_dB, flap_open, rows)

        def at(address: str) -> FakeCamera:
            return FakeCamera(
                self.plant,
                self.clock,
                render,
                address,
                settings.serial_number or "",
                real_time=not self.spec.virtual,
                warms_up=not self.spec.virtual and not has_flap,  # a shut flap's warms nothing
                pace_MBps=_PACE_MBps[self.spec.virtual] if len(self._cameras) < 2 else _LINE_MBps,
                boot_s=self.spec.camera_boot_s,
                genicam=genicam,
                thermometers=self.published.get(name),
            )

        return at(settings.address) if settings.address else _bind_free_address(at)

    def _share_a_switch(self) -> None:
        """Put a switch between several cameras and the computer; in virtual time they take turns, and need none."""
        if not self.is_virtual and len(self.cameras) > 1:
            self.switch = Switch(_LINE_MBps)
            for camera in self.cameras.values():
                camera.faults.switch = self.switch

    def _conduct(self, time_ns: int, dt_s: float) -> None:
        """A welded solid-state relay conducts regardless of the regulator; a camera without cooling stays hot."""
        self.plant.heater_on_fraction = max(self.plant.heater_on_fraction, self.ssr_welded_share)
        if self.camera_sensor_degC is not None:
            self.plant.sensor_degC = self.camera_sensor_degC
        for camera in self.published.values():
            camera.held_chip_degC = self.camera_sensor_degC


def _bind_free_address(at: Callable[[str], FakeCamera]) -> FakeCamera:
    number, tries_left = secrets.SystemRandom(), _FREE_ADDRESS_TRIES
    while True:
        address = f"127.{number.randrange(64, 255)}.{number.randrange(256)}.{number.randrange(1, 255)}"
        try:
            return at(address)
        except OSError:
            tries_left -= 1
            if not tries_left:
                raise


@fake("cameras", rank=CAMERAS)
def _build_camera(bench: Bench, name: str, settings: Mapping[str, Any]) -> FakeCamera:
    camera = bench.camera_at(name)
    bench.register_address(name, camera.address, camera.close)
    camera.start()
    return camera
