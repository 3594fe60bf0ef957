"""Two fake flap controllers behind pyusb, the driver, and one virtual time, for the tests of the flap driver."""

import asyncio
import errno
import struct
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress

from usb.core import USBError

from tests.still_plant import StillPlant
from thermostand.drivers.devices.motion.flap import Flap, FlapSettings
from thermostand.drivers.sim.motion.flap import MAX_DUTY_FORWARD, FakeFlap
from thermostand.drivers.sim.usb import ForwardingBackend, Handle, TransferFailed, UsbServer
from thermostand.foundation.clock import FollowedClock, VirtualClock, to_ns
from thermostand.foundation.readings import Quality, Reading

T0 = 1_700_000_000_000_000_000
OURS, OTHER = "00351210", "00351299"
SETTINGS = FlapSettings(serial_number=OURS, open_target=3500, closed_target=500, tolerance=40, travel_s=5.0)
SET_TARGET, STOP_MOTOR, GET_VARIABLES, GET_RAM_SETTINGS = 0x84, 0x87, 0xE5, 0xEA


class TappedFlap(FakeFlap):
    """Notes its requests; `failures` are for the coming ones of a number, `short` how many reads are cut short."""

    def __init__(self, plant: StillPlant, clock: FollowedClock, serial_number: str) -> None:
        self.requests: list[tuple[int, int]] = []  # request, value
        self.failures: list[tuple[int, TransferFailed]] = []
        self.short = 0
        super().__init__(plant, clock, serial_number)

    def control_transfer(
        self, request_type: int, request: int, value: int, index: int, length_or_data: int | bytes
    ) -> bytes:
        self.requests.append((request, value))
        if self.failures and self.failures[0][0] == request:
            raise self.failures.pop(0)[1]
        reply = super().control_transfer(request_type, request, value, index, length_or_data)
        if self.short > 0 and request == GET_VARIABLES:
            self.short -= 1
            return reply[:-1]
        return reply

    @property
    def targets(self) -> list[int]:
        return [value for request, value in self.requests if request == SET_TARGET]


class GuardedBackend(ForwardingBackend):
    """As on a machine without the udev rule for some devices: they are listed but cannot be opened."""

    def __init__(self, host: str, port: int) -> None:
        super().__init__(host, port)
        self.forbidden: set[int] = set()  # indices

    def open_device(self, dev: Handle) -> Handle:
        if dev.index in self.forbidden:
            raise USBError("Access denied (insufficient permissions)", -3, errno.EACCES)
        return super().open_device(dev)


class Bench:
    """Two controllers on one bus, ours the second; one virtual time for them and the driver."""

    def __init__(self) -> None:
        self.plant = StillPlant(T0)
        self.followed = FollowedClock(T0)
        self.other = TappedFlap(self.plant, self.followed, OTHER)
        self.fake = TappedFlap(self.plant, self.followed, OURS)
        self.server = UsbServer("127.0.0.1", 0, [self.other, self.fake])
        self.backend = GuardedBackend("127.0.0.1", self.server.port)
        self.clock = VirtualClock(T0, self._advance)
        self._while_advancing: Callable[[], Awaitable[object]] | None = None
        self._begun: asyncio.Future[object] | None = None
        self.flap = Flap("flap", SETTINGS, self.clock, self.backend)

    async def _advance(self, time_ns: int) -> None:
        """As the simulator's answer does, it comes some turns of the event loop later."""
        self.followed.follow(time_ns)
        if (action := self._while_advancing) is not None:
            self._while_advancing = None
            self._begun = asyncio.ensure_future(action())
            for _ in range(10):
                await asyncio.sleep(0)

    async def act_while_time_moves(self, by_s: float, action: Callable[[], Awaitable[object]]) -> None:
        """Begin something from outside of virtual time, while the simulator is set to an instant that much ahead."""
        self._while_advancing = action
        await self.wait(by_s)
        assert self._begun is not None
        await self._begun

    @property
    def now_s(self) -> float:
        return (self.clock.now_ns() - T0) / 1e9

    @property
    def openness(self) -> float:
        return self.plant.flap_open_at(self.followed.now_ns())

    async def wait(self, duration_s: float) -> None:
        await self.clock.sleep_until(self.clock.now_ns() + to_ns(duration_s))

    async def after(self, delay_s: float, action: Callable[[], Awaitable[object] | None]) -> None:
        """Do something while something else is going on."""
        await self.wait(delay_s)
        if (work := action()) is not None:
            await work

    async def position(self) -> Reading:
        position, current = await self.flap.read()
        assert (current.channel, current.unit, current.quality) == ("flap.current", "mA", Quality.GOOD)
        return position

    def set_max_duty(self, duty: int) -> None:
        self.fake.control_transfer(0x40, 0xE6, 0, MAX_DUTY_FORWARD, struct.pack("<HH", duty, duty))


@asynccontextmanager
async def running_bench() -> AsyncGenerator[Bench]:
    """Time runs inside."""
    bench = Bench()
    driver = asyncio.create_task(bench.clock.run())
    yield bench
    await bench.flap.close()
    bench.backend.finalize()
    bench.server.close()
    driver.cancel()
    with suppress(asyncio.CancelledError):
        await driver
