"""Devices in memory for a stand in virtual time: each command takes a second and is noted in `calls`."""

import asyncio
import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any, ClassVar, cast

import numpy as np

from thermostand.drivers.devices.protocols import InForce
from thermostand.drivers.devices.relays import CAMERA_POWER
from thermostand.drivers.settings import CameraSettings, Identity
from thermostand.foundation.clock import VirtualClock, to_ns
from thermostand.foundation.errors import StandError
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event, Item
from thermostand.foundation.readings import Frame, Quality, Reading
from thermostand.stand.assembly.stand import Devices, Stand
from thermostand.stand.chamber.chamber import ChamberLimits
from thermostand.stand.chamber.permits import COMPRESSOR, HEATER, PermitLimits
from thermostand.stand.config.stand_config import CompressorConfig
from thermostand.stand.imaging.camera_supply import SupplyLimits
from thermostand.stand.safety.fault import Fault
from thermostand.stand.safety.gate import STOPPING

COMPRESSOR_LIMITS = CompressorConfig(start_above_cool_percent=20)


@dataclass
class Device:
    """`failures` are raised by the next commands, one each."""

    name: str
    clock: VirtualClock
    calls: list[str]
    failures: list[StandError] = field(default_factory=list)

    async def act(self, call: str) -> None:
        self.calls.append(f"{self.name} {call}")
        await self.clock.sleep_until(self.clock.now_ns() + to_ns(1))
        if self.failures:
            raise self.failures.pop(0)

    async def make_safe(self) -> None:
        await self.act("make_safe")

    def allow(self) -> None:
        pass


@dataclass
class Regulator(Device):
    mv_heat: float = 0.0
    pv_degC: float = 24.0

    async def read(self):
        now_ns = self.clock.now_ns()
        found = {"mv_heat": self.mv_heat, "running": self.mv_heat, "pv": self.pv_degC}
        return tuple(Reading(f"regulator.{name}", value, "1", now_ns) for name, value in found.items())

    async def in_force(self) -> InForce:
        return InForce("nothing stands between")

    async def set_temperature(self, degC: float) -> None:
        await self.act(f"sp {degC:g}")

    async def run(self) -> None:
        await self.act("run")

    async def stop(self) -> None:
        await self.act("stop")


@dataclass
class Relays(Device):
    """What was held on stays on until it is switched."""

    has_timer: ClassVar[bool] = True
    on: set[str] = field(default_factory=set)

    async def read(self):
        names = (HEATER, COMPRESSOR, CAMERA_POWER)
        return tuple(Reading(f"relays.{name}", float(name in self.on), "1", self.clock.now_ns()) for name in names)

    async def switch(self, channel: str, on: bool) -> None:
        await self.act(f"{channel} {'on' if on else 'off'}")
        (self.on.add if on else self.on.discard)(channel)

    async def hold_on(self, channel: str, duration_s: float) -> None:
        await self.act(f"{channel} held")
        self.on.add(channel)

    async def make_safe(self) -> None:
        await super().make_safe()
        self.on -= {HEATER, COMPRESSOR}


@dataclass
class Flap(Device):
    is_shut: bool = True

    async def move_open(self) -> None:
        self.is_shut = False
        await self.act("open")

    async def move_closed(self) -> None:
        await self.act("closed")
        self.is_shut = True


@dataclass
class Camera(Device):
    restarted: str = ""
    is_usable: bool = True
    frames: int = 0
    settings: ClassVar[CameraSettings] = CameraSettings(address="127.0.0.20", lens="25 mm")
    identity: ClassVar[Identity] = Identity("Make", "Model", "1", "2.0")

    async def open(self) -> None:
        await self.act("open")

    async def close(self) -> None:
        await self.act("close")

    async def grab(self, exposure_s: float | None = None, due_ns: int = 0) -> Frame:
        await self.act("grab")
        self.frames += 1
        image = np.zeros((2, 3), np.uint8)
        return Frame(f"{self.name}.image", image, self.clock.now_ns(), exposure_s or 0.0, 0.0, 40.0, self.frames, 0)


@dataclass
class StageProfile:
    unit: str = "mm"
    unit_per_step: float = 0.0025
    home_from: float | None = None


@dataclass
class Stage(Device):
    profile: StageProfile = field(default_factory=StageProfile)
    has_scale: bool = True
    position: float = 0.0
    reason: str = ""

    async def homed(self) -> bool:
        return self.has_scale

    async def home(self) -> float:
        await self.act("home")
        self.has_scale, self.position = True, 0.0
        return 0.001

    async def move_to(self, position: float) -> None:
        await self.act(f"to {position:g}")
        self.position = position

    async def read(self):
        quality = Quality.STALE if self.reason else Quality.GOOD
        return (Reading(f"{self.name}.position", self.position, "mm", self.clock.now_ns(), quality, self.reason),)


class MemoryStand:
    """A stand of these devices, and what it published."""

    def __init__(self, K_per_min: float = math.inf) -> None:
        self.clock, self.hub = VirtualClock(0), Hub()
        self.calls: list[str] = []
        self.items: list[Item] = []
        self.hub.subscribe(self.items.append)
        here = self.clock, self.calls
        self.regulator, self.relays = Regulator("regulator", *here), Relays("relays", *here)
        self.flap, self.camera, self.linear = Flap("flap", *here), Camera("camera", *here), Stage("linear", *here)
        # Duck-typed on purpose: the stand takes the drivers' classes, and these speak to no wire.
        devices = Devices(
            cast("dict[str, Any]", {each.name: each for each in (self.regulator, self.relays, self.flap)}),
            axes={"linear": cast("Any", self.linear)},
            cameras={"camera": cast("Any", self.camera)},
        )
        chamber = ChamberLimits((-10.0, 60.0), PermitLimits(15.0, 3.0, COMPRESSOR_LIMITS), 5.0, None, K_per_min)
        self.stand = Stand(devices, chamber, SupplyLimits(2.0, 15.0), self.hub, self.clock)

    @property
    def events(self) -> list[Event]:
        return [item for item in self.items if isinstance(item, Event)]

    @property
    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]

    @property
    def frames(self) -> list[Frame]:
        return [item for item in self.items if isinstance(item, Frame)]

    async def passes(self, duration_s: float) -> None:
        await self.clock.sleep_until(self.clock.now_ns() + to_ns(duration_s))


@asynccontextmanager
async def run_memory_stand(K_per_min: float = math.inf) -> AsyncIterator[MemoryStand]:
    """The stand, with its time going on while inside."""
    here = MemoryStand(K_per_min)
    time = asyncio.create_task(here.clock.run())
    try:
        yield here
    finally:
        await here.stand.safety.close()
        time.cancel()


def trip(stand: Stand, fault: Fault) -> None:
    """As the guard ends a run."""
    stand.latch.trip(fault)
    stand.gate.hold(STOPPING)
