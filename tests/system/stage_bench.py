"""A fake stage on a wire, its driver, and one virtual time for both, for the tests of the stage driver."""

import asyncio
import struct
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Literal

from tests.still_plant import StillPlant
from thermostand.drivers.devices.motion.stage import Axis, AxisSettings
from thermostand.drivers.framing.ximc import encode
from thermostand.drivers.sim.motion.ximc import FakeAxis, XimcEngine
from thermostand.drivers.sim.motion.ximc_table import LINEAR_8MT160_300, ROTARY_8MR151
from thermostand.drivers.sim.wire import LinkFaults, PtyWire, TcpWire
from thermostand.foundation.clock import FollowedClock, VirtualClock, to_ns
from thermostand.foundation.readings import Reading

T0 = 1_700_000_000_000_000_000
SERIAL_NUMBER = 4101
START_STEPS = {"linear": 100.0, "rotary": 1300.0}  # to the right of home, where the count is 0
UNIT_PER_STEP = {"linear": 0.0025, "rotary": 0.01}
OVERSHOOT = {"linear": 0.5, "rotary": 1.0}
LIMITS = {"linear": (0.0, 299.95), "rotary": (-40.0, 40.0)}
ENGINE_LAYOUT = "<HHIBHhBH12x"  # microstep mode is field 6

Kind = Literal["linear", "rotary"]


class Tap:
    """Listens to a controller's conversation. `lost_requests`: how many requests with these letters never reach it,
    `lost_replies`: how many of its answers never leave, `ignored`: letters it acknowledges without acting."""

    def __init__(self, engine: XimcEngine) -> None:
        self._engine = engine
        self.requests: list[str] = []
        self.lost_requests: dict[str, int] = {}
        self.lost_replies: dict[str, int] = {}
        self.ignored: set[str] = set()

    def feed(self, data: bytes) -> bytes:
        if not data.strip(b"\0"):
            return self._engine.feed(data)
        letters = data.lstrip(b"\0")[:4].decode()
        self.requests.append(letters)
        if self.lost_requests.get(letters, 0) > 0:
            self.lost_requests[letters] -= 1
            return b""
        acknowledged = data[: data.index(letters.encode()) + 4]  # the zero in front, too
        reply = acknowledged if letters in self.ignored else self._engine.feed(data)
        if self.lost_replies.get(letters, 0) > 0:
            self.lost_replies[letters] -= 1
            return b""
        return reply

    def count(self, letters: str) -> int:
        return self.requests.count(letters)


class Bench:
    """A stage with its controller on a wire, its driver, and one virtual time for both."""

    def __init__(self, kind: Kind, wire: str, folder: Path) -> None:
        self.kind: Kind = kind
        self.plant = StillPlant(T0)
        self.followed = FollowedClock(T0)
        self.clock = VirtualClock(T0, self._advance)
        self.trajectory: list[float] = []  # mechanical, whenever time moved since the last move began
        self.faults = LinkFaults(seed=3)
        self.fake = self.controller(SERIAL_NUMBER)
        self.tap = Tap(self.fake.engine())
        self._path = folder / kind
        self._wire = self.plug(self.tap, wire)
        self.address = f"tcp:127.0.0.1:{self._wire.port}" if isinstance(self._wire, TcpWire) else f"serial:{self._path}"
        profile = "8MT160-300" if kind == "linear" else "8MR151"
        self.axis = Axis(
            kind,
            AxisSettings(address=self.address, serial_number=SERIAL_NUMBER, profile=profile, limits=LIMITS[kind]),
            self.clock,
        )

    def controller(self, serial_number: int) -> FakeAxis:
        profile = LINEAR_8MT160_300 if self.kind == "linear" else ROTARY_8MR151
        return FakeAxis(self.plant, self.followed, profile, serial_number, self.kind, START_STEPS[self.kind])

    def plug(self, tap: Tap, wire: str = "serial", port: int = 0) -> PtyWire | TcpWire:
        if wire == "serial":
            self._wire: PtyWire | TcpWire = PtyWire(self._path, tap, self.faults)
        else:
            self._wire = TcpWire("127.0.0.1", port, lambda: tap, self.faults)
        return self._wire

    def unplug(self) -> None:
        self._wire.close()

    async def _advance(self, time_ns: int) -> None:
        self.followed.follow(time_ns)
        self.trajectory.append(self.mechanical)

    @property
    def mechanical(self) -> float:
        """mm or degrees, now."""
        now_ns = self.followed.now_ns()
        return self.plant.linear_mm_at(now_ns) if self.kind == "linear" else self.plant.rotary_deg_at(now_ns)

    @property
    def now_s(self) -> float:
        return (self.clock.now_ns() - T0) / 1e9

    async def after(self, delay_s: float, action: Callable[[], Awaitable[object] | None]) -> None:
        """Do something while something else is going on."""
        await self.clock.sleep_until(self.clock.now_ns() + to_ns(delay_s))
        if (work := action()) is not None:
            await work

    async def ready(self) -> Axis:
        """Open and homed."""
        await self.axis.open()
        await self.axis.home()
        return self.axis

    async def move(self, position: float) -> list[float]:
        """Move there; the mechanical trajectory on the way."""
        self.trajectory = [self.mechanical]
        await self.axis.move_to(position)
        return self.trajectory

    async def position(self) -> Reading:
        position, moving, _ = await self.axis.read()
        assert moving.value == 0
        return position

    def another(self, name: str, serial_number: int) -> Axis:
        """A driver that expects somebody else at the same address."""
        return Axis(
            name,
            AxisSettings(address=self.address, serial_number=serial_number, profile="8MR151", limits=(0.0, 1.0)),
            self.clock,
        )

    def set_speed(self, steps_s: int) -> None:
        """As somebody with the vendor's program would."""
        self._change("mov", "<IBHHIBB9x", 0, steps_s)

    def set_thousandths(self) -> None:
        """Speeds in 1/1000 steps/s, by MoveFlags."""
        self._change("mov", "<IBHHIBB9x", 6, 1)

    def set_power_off(self, after_s: int | None) -> None:
        """After how long at rest its motor goes off, None for never."""
        self._change("pwr", "<BHHHB6x", 4, 5 if after_s is None else 7)

    def _change(self, name: str, layout: str, field: int, value: int) -> None:
        fields = list(struct.unpack(layout, self.fake.engine().feed(f"g{name}".encode())[4:-2]))
        fields[field] = value
        self.fake.engine().feed(encode(f"s{name}", struct.pack(layout, *fields)))

    def change_microsteps(self, mode: int) -> None:
        """As somebody with the vendor's program would, and saved."""
        self._change("eng", ENGINE_LAYOUT, 6, mode)
        self.fake.engine().feed(b"save")


@asynccontextmanager
async def running_bench(kind: Kind, wire: str, folder: Path) -> AsyncGenerator[Bench]:
    """`wire`: serial or tcp. Time runs inside."""
    bench = Bench(kind, wire, folder)
    driver = asyncio.create_task(bench.clock.run())
    yield bench
    await bench.axis.close()
    bench.unplug()
    driver.cancel()
    with suppress(asyncio.CancelledError):
        await driver
