"""The inspection flap: a Pololu Jrk G2 over its native USB interface (Jrk G2 user's guide, sections 9-14)."""

from __future__ import annotations

import errno
import importlib
import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol, Self, cast

import usb.backend
import usb.core
import usb.util
from pydantic import Field, model_validator

from thermostand.drivers.devices.device_check import DeviceCheck
from thermostand.drivers.devices.kinds import Absence, DeviceKind, DriverContext, LockedPlace, Verb
from thermostand.drivers.devices.motion.motion import MotionArbiter, MotionCommand
from thermostand.drivers.settings import Identity, Polled, check_same_device
from thermostand.foundation.addresses import TcpAddress
from thermostand.foundation.clock import Clock, to_ns
from thermostand.foundation.errors import (
    ConfigError,
    DeviceError,
    DeviceFault,
    GarbledReply,
    Refused,
    Superseded,
    Unreachable,
)
from thermostand.foundation.readings import Channel, Quality, Reading, bad_reading
from thermostand.foundation.workers import Result, WorkerThread

_VENDOR_POLOLU = 0x1FFB
_PRODUCTS_JRK_G2 = {0x00B7: "18v27", 0x00B9: "24v21", 0x00BF: "18v19", 0x00C1: "24v13", 0x00C5: "21v3"}
_TO_DEVICE, _TO_HOST = 0x40, 0xC0
_SET_TARGET, _STOP_MOTOR, _GET_VARIABLES, _GET_RAM_SETTINGS = 0x84, 0x87, 0xE5, 0xEA
_CLEAR_HALTING = 1  # value of _GET_VARIABLES: clear the errors whose cause is gone
_TIMEOUT_MS = 1600  # the device may need 1,500 ms after restoring its defaults
_VARIABLES_SIZE = 0x35
_INPUT_MODE_OFFSET, _INPUT_MODE_SERIAL = 0x03, 0
_MAX_DUTY_OFFSET, _MAX_DUTY = 0x68, struct.Struct("<HH")  # forward, reverse
_ENGLISH = 0x0409  # the language of its string descriptors

_AWAITING_COMMAND = 0x0001
_FEEDBACK_DISCONNECT = 0x0020
_ERROR_NAMES = (
    "awaiting command", "no power", "motor driver error", "input invalid", "input disconnect", "feedback disconnect",
    "soft over-current", "serial signal error", "serial overrun", "serial buffer full", "serial CRC error",
    "serial protocol error", "serial time-out", "hard over-current",
)  # fmt: skip

# The drive reports no jam by itself: its duty is saturated and its feedback still, for JAM_S.
_JAM_DUTY = 0.9  # of the configured maximum
POLL_S = 0.05  # round number; nothing was measured
CONFIRMATIONS = 3  # looks in a row: one may be taken in passing
JAM_S = 0.5  # ten looks; round number, nothing was measured
JAM_COUNTS = 8  # of 4095; less is taken for the feedback's noise
# Of the time between two looks no more than this counts: while nobody looks, because the event loop or the host was
# held up, nothing is known of the flap. So a jam takes five looks at the least.
_LONGEST_LOOK_S = 2 * POLL_S


class FlapSettings(Polled):
    """serial_number: of the USB device. backend: a module with `get_backend(address)` that gives a pyusb backend; none
    means libusb, the real bus. Targets, tolerance: scaled feedback counts. travel_s: longest time a whole travel may
    take on the stand's clock."""

    serial_number: str = Field(pattern=r"^[!-~]{1,32}$")
    backend: str | None = Field(default=None, pattern=r"^[A-Za-z_][A-Za-z0-9_]*(\.[A-Za-z_][A-Za-z0-9_]*)*$")
    backend_address: TcpAddress | None = None
    open_target: int = Field(default=3500, ge=0, le=4095)
    closed_target: int = Field(default=500, ge=0, le=4095)
    tolerance: int = Field(default=40, ge=1, le=500)
    travel_s: float = Field(default=5.0, gt=0, le=60)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if abs(self.open_target - self.closed_target) <= 2 * self.tolerance:
            raise ValueError("open_target and closed_target are closer than twice the tolerance")
        if (self.backend is None) != (self.backend_address is None):
            raise ValueError("backend and backend_address go together")
        return self


@dataclass(frozen=True, slots=True)
class _Variables:
    time_ns: int  # when they were read
    target: int
    position: int
    duty: int
    halting: int
    current_mA: int


class _UsbDevice(Protocol):
    """What of a pyusb device is used here; pyusb makes these attributes at run time."""

    idProduct: int
    bcdDevice: int
    iSerialNumber: int

    def ctrl_transfer(
        self, bmRequestType: int, bRequest: int, wValue: int, wIndex: int, data_or_wLength: int | None, timeout: int
    ) -> int | bytes: ...


class Travel:
    """One movement from `position` to `target` (scaled feedback, counts), begun at `time_ns`, with the target sent."""

    def __init__(self, target: int, tolerance: int, travel_s: float, position: int, time_ns: int) -> None:
        self._target = target
        self._tolerance = tolerance
        self._travel_s = travel_s
        self._seen_ns = time_ns
        self._watched_ns = 0
        self._still_ns = 0
        self._still_position = position
        self._confirmed = 0

    @property
    def has_arrived(self) -> bool:
        """It was at its target in three looks in a row."""
        return self._confirmed >= CONFIRMATIONS

    def look(self, position: int, saturated: bool, time_ns: int) -> str:
        """Return what is wrong, "" when nothing is; `time_ns` is when the position was read, `saturated` whether the
        motor gave (nearly) all it may."""
        step_ns = min(max(0, time_ns - self._seen_ns), to_ns(_LONGEST_LOOK_S))
        self._seen_ns = time_ns
        self._watched_ns += step_ns
        self._still_ns += step_ns
        if abs(position - self._still_position) >= JAM_COUNTS:
            self._still_ns, self._still_position = 0, position
        self._confirmed = self._confirmed + 1 if abs(position - self._target) <= self._tolerance else 0
        if saturated and self._still_ns >= to_ns(JAM_S):
            return f"jammed at {position} on the way to {self._target}"
        if not self._confirmed and self._watched_ns > to_ns(self._travel_s):
            return f"at {position}, not at {self._target}, after {self._travel_s:g} s"
        return ""


class Flap:
    """The flap. `backend` is a pyusb backend, None for libusb; the position is unknown until it was read.

    After any USB error the controller is found again, by its serial number, at the next call. There is one mover: the
    newest movement wins, and one in the other direction that was under way ends with Superseded.
    """

    def __init__(self, name: str, settings: FlapSettings, clock: Clock, backend: usb.backend.IBackend | None) -> None:
        self.name = name
        self._settings = settings
        self._clock = clock
        self._backend = backend
        self._worker: WorkerThread | None = None
        self._device: _UsbDevice | None = None
        self._max_duty = (0, 0)
        self.identity: Identity | None = None  # which controller has answered
        self.is_shut = False  # the last movement has confirmed it
        self._commanded = False  # a target was sent and the motor not stopped since
        self._motion = MotionArbiter(name)

    async def open(self) -> None:
        """Find the controller by its serial number and check its input mode; leaves the flap where it is."""
        if self._worker is None:
            self._worker = WorkerThread(self.name, self._clock)
        await self._call(self._find)

    async def close(self) -> None:
        """Let go of the USB device; the flap stays where it is. May be called twice."""
        lane, self._worker = self._worker, None
        if lane is not None:
            await lane.call(self._release)
            lane.close()

    async def read(self) -> tuple[Reading, ...]:
        """(position 0 closed .. 1 open, motor current mA). The position is BAD when the feedback is disconnected, and
        STALE, with the reason, when an error or a restart of the controller has taken the motor's force away."""
        variables = await self._call(self._read_variables)
        now_ns = self._clock.now_ns()
        current = Reading(f"{self.name}.current", float(variables.current_mA), "mA", now_ns)
        channel = f"{self.name}.position"
        if variables.halting & _FEEDBACK_DISCONNECT:
            return bad_reading(channel, "1", now_ns, "feedback disconnect"), current
        span = self._settings.open_target - self._settings.closed_target
        openness = (variables.position - self._settings.closed_target) / span
        if variables.halting & ~_AWAITING_COMMAND or (variables.halting and self._commanded):
            reason = f"the motor is not driven: {_name_errors(variables.halting)}"
            return Reading(channel, openness, "1", now_ns, Quality.STALE, reason), current
        return Reading(channel, openness, "1", now_ns), current

    def allow(self) -> None:
        """It may be opened again after it was made safe."""
        self._motion.allow()

    async def move_open(self) -> None:
        """Open and confirm; DeviceFault on a jam, an error flag or when the travel takes too long, Superseded when it
        is closed meanwhile, or was made safe and not allowed to move since.

        Errors that stopped an earlier movement are cleared when their cause is gone.
        """
        await self._move(self._motion.take(self._settings.open_target), self._settings.open_target)

    async def move_closed(self) -> None:
        """Close and confirm, also when it was made safe; errors as in move_open."""
        await self._move(self._motion.take(self._settings.closed_target, safe=True), self._settings.closed_target)

    async def make_safe(self) -> None:
        """Closed: the chamber is then a closed box, and the drive's own force limit protects what is in between. It
        stays closed until `allow`."""
        self._motion.bar()
        await self.move_closed()

    async def _move(self, turn: MotionCommand, target: int) -> None:
        self.is_shut = False
        await self._move_to(turn, target)
        self.is_shut = target == self._settings.closed_target

    async def _move_to(self, turn: MotionCommand, target: int) -> None:
        settings = self._settings
        begun = await self._call(self._set_target, turn, target)
        travel = Travel(target, settings.tolerance, settings.travel_s, begun.position, begun.time_ns)
        while not travel.has_arrived:
            await self._clock.sleep_until(self._clock.now_ns() + to_ns(POLL_S))
            variables = await self._call(self._read_variables)
            turn.check()
            if variables.halting or variables.target != target:
                raise DeviceFault(self.name, f"the motor stopped: {_name_errors(variables.halting)}")
            if trouble := travel.look(variables.position, self._is_saturated(variables.duty), variables.time_ns):
                await self._stop_after(turn, trouble)

    def _is_saturated(self, duty: int) -> bool:
        return duty != 0 and abs(duty) >= _JAM_DUTY * self._max_duty[duty < 0]

    async def _stop_after(self, turn: MotionCommand, reason: str) -> None:
        try:
            await self._call(self._stop_motor, turn)
        except Superseded:
            raise
        except DeviceError as error:
            raise DeviceFault(self.name, f"{reason}; the motor could not be stopped ({error})") from error
        raise DeviceFault(self.name, f"{reason}; the motor is stopped")

    async def _call(self, function: Callable[..., Result], *args: object) -> Result:
        if self._worker is None:
            raise Unreachable(self.name, "not open")
        return await self._worker.call(function, *args)

    # Below: in the lane's thread.

    def _find(self) -> _UsbDevice:
        """Our controller among those that are plugged in, its settings checked; the others are left alone."""
        self._release()
        try:
            found = cast(
                "Iterable[_UsbDevice]",
                usb.core.find(find_all=True, backend=self._backend, idVendor=_VENDOR_POLOLU),
            )
            candidates = [device for device in found if device.idProduct in _PRODUCTS_JRK_G2]
        except usb.core.NoBackendError as error:
            raise Unreachable(self.name, "libusb is not installed (Debian package libusb-1.0-0)") from error
        except (usb.core.USBError, ValueError, OSError) as error:
            raise Unreachable(self.name, f"USB devices cannot be listed ({error})") from error
        self._device = self._choose(candidates)
        try:
            self.identity = check_same_device(self.name, self._read_identity(self._device), self.identity)
            self._check_settings(self._device)
        except DeviceError:
            self._release()
            raise
        return self._device

    def _choose(self, candidates: Iterable[_UsbDevice]) -> _UsbDevice:
        """The one with our serial number; one that does not report its own (no permission, busy) hides no other."""
        chosen: _UsbDevice | None = None
        present: list[str] = []
        denied: usb.core.USBError | None = None
        for device in candidates:
            try:
                serial_number = str(usb.util.get_string(device, device.iSerialNumber, _ENGLISH))
            except (usb.core.USBError, ValueError, LookupError) as error:
                serial_number = f"one that does not report its own ({error})"
                if isinstance(error, usb.core.USBError) and error.errno == errno.EACCES:
                    denied = error
            present.append(serial_number)
            if serial_number == self._settings.serial_number:
                chosen = device
            else:
                usb.util.dispose_resources(device)
        if chosen is not None:
            return chosen
        if denied is not None:  # it may be ours
            raise self._make_error(denied, "serial number") from denied
        others = f"only {', '.join(sorted(present))}" if present else "and no other"
        raise Unreachable(
            self.name, f"no Jrk G2 with serial number {self._settings.serial_number} is connected, {others}"
        )

    def _read_identity(self, device: _UsbDevice) -> Identity:
        """Read the serial number by which it was found, and the version of its firmware, binary coded decimal."""
        version = f"{device.bcdDevice >> 8:x}.{device.bcdDevice & 0xFF:02x}"
        model = f"Jrk G2 {_PRODUCTS_JRK_G2[device.idProduct]}"
        return Identity("Pololu", model, self._settings.serial_number, version)

    def _check_settings(self, device: _UsbDevice) -> None:
        """Check the settings in force, that is in RAM; they are read before every target, because a restart may change
        them."""
        (mode,) = self._read(device, _GET_RAM_SETTINGS, 0, _INPUT_MODE_OFFSET, 1)
        if mode != _INPUT_MODE_SERIAL:
            raise Refused(self.name, f"the Jrk's input mode is {mode}, it must be 0 (serial) to obey targets")
        self._max_duty = _MAX_DUTY.unpack(self._read(device, _GET_RAM_SETTINGS, 0, _MAX_DUTY_OFFSET, _MAX_DUTY.size))

    def _release(self) -> None:
        if self._device is not None:
            usb.util.dispose_resources(self._device)
        self._device = None

    def _set_target(self, turn: MotionCommand, target: int) -> _Variables:
        """Send the target, then clear old errors: in this order the motor never starts towards the old target. All of
        it is idempotent and may be repeated once. The variables are those before the errors were cleared."""
        try:
            return self._set_target_once(turn, target)
        except Unreachable:
            return self._set_target_once(turn, target)

    def _set_target_once(self, turn: MotionCommand, target: int) -> _Variables:
        device = self._device or self._find()
        self._check_settings(device)
        turn.check()
        self._transfer(device, _TO_DEVICE, _SET_TARGET, target, 0, 0)
        self._commanded = True
        return self._decode(self._read(device, _GET_VARIABLES, _CLEAR_HALTING, 0, _VARIABLES_SIZE))

    def _stop_motor(self, turn: MotionCommand) -> None:
        """Idempotent too; the motor of a newer movement is left alone."""
        turn.check()
        self._commanded = False
        try:
            self._transfer(self._device or self._find(), _TO_DEVICE, _STOP_MOTOR, 0, 0, 0)
        except Unreachable:
            self._transfer(self._device or self._find(), _TO_DEVICE, _STOP_MOTOR, 0, 0, 0)

    def _read_variables(self) -> _Variables:
        return self._decode(self._read(self._device or self._find(), _GET_VARIABLES, 0, 0, _VARIABLES_SIZE))

    def _decode(self, block: bytes) -> _Variables:
        """Jrk G2 user's guide, section 12: variables."""
        target, position, duty, halting, current_mA = (
            struct.unpack_from(kind, block, offset)[0]
            for kind, offset in (("<H", 0x02), ("<H", 0x06), ("<h", 0x0C), ("<H", 0x12), ("<H", 0x19))
        )
        return _Variables(self._clock.now_ns(), target, position, duty, halting, current_mA)

    def _read(self, device: _UsbDevice, request: int, value: int, index: int, size: int) -> bytes:
        """`size` bytes from the device; a short answer is asked for once more."""
        try:
            return self._transfer(device, _TO_HOST, request, value, index, size)
        except GarbledReply:
            return self._transfer(device, _TO_HOST, request, value, index, size)

    def _transfer(
        self, device: _UsbDevice, request_type: int, request: int, value: int, index: int, size: int
    ) -> bytes:
        try:
            answer = device.ctrl_transfer(request_type, request, value, index, size or None, _TIMEOUT_MS)
        except usb.core.USBError as error:
            self._release()
            raise self._make_error(error, f"request 0x{request:02X}") from error
        data = b"" if isinstance(answer, int) else bytes(answer)
        if len(data) != size:
            raise GarbledReply(self.name, f"request 0x{request:02X} gave {len(data)} of {size} bytes")
        return data

    def _make_error(self, error: usb.core.USBError, what: str) -> DeviceError:
        """pyusb's errors by errno, never by text."""
        if error.errno == errno.EPIPE:
            return Refused(self.name, f"the Jrk stalled {what}")
        if error.errno == errno.EACCES:
            return Refused(self.name, "no permission for the USB device; install Pololu's udev rule")
        return Unreachable(self.name, f"USB: {what} failed ({error})")


def _name_errors(halting: int) -> str:
    names = [name for bit, name in enumerate(_ERROR_NAMES) if halting >> bit & 1]
    return ", ".join(names) or "its target was changed by someone else"


class NoFlap:
    """Stands in place of a flap: cameras see the target all the time, and opening and closing are done at once. What
    was commanded last is remembered, nothing is read."""

    identity = None

    def __init__(self, name: str, _: Clock) -> None:
        self.name = name
        self.is_shut = True

    async def open(self) -> None:
        """Do nothing: there is no device to connect to."""

    async def close(self) -> None:
        """Do nothing: there is nothing to release."""

    async def read(self) -> tuple[Reading, ...]:
        """Return nothing: there is nothing to read."""
        return ()

    async def move_open(self) -> None:
        """Note the command; nothing moves."""
        self.is_shut = False

    async def move_closed(self) -> None:
        """Note the command; nothing moves."""
        self.is_shut = True

    async def make_safe(self) -> None:
        """Do the same as for closed."""
        self.is_shut = True

    def allow(self) -> None:
        """Do nothing: nothing was barred."""


class _BackendModule(Protocol):
    def get_backend(self, address: str) -> usb.backend.IBackend: ...


def _make(name: str, settings: FlapSettings, around: DriverContext) -> Flap:
    backend: usb.backend.IBackend | None = None
    if settings.backend is not None and settings.backend_address is not None:
        try:
            module = cast("_BackendModule", importlib.import_module(settings.backend))
        except ImportError as error:
            raise ConfigError(f"flap.backend: no module {settings.backend!r} ({error})") from error
        if not callable(getattr(module, "get_backend", None)):
            raise ConfigError(f"flap.backend: module {settings.backend!r} has no get_backend(address)")
        try:
            backend = module.get_backend(settings.backend_address)
        except ValueError as error:
            raise ConfigError(f"flap.backend_address: {error}") from error
    return Flap(name, settings, around.clock, backend)


def _places(settings: FlapSettings) -> Iterator[LockedPlace]:
    if settings.backend_address is None:
        yield LockedPlace("name", f"usb {settings.serial_number}")
    else:
        yield LockedPlace("wire", settings.backend_address)


def _advise(error: DeviceError, name: str, settings: FlapSettings) -> str:
    if isinstance(error, Unreachable):
        return "is it plugged in and powered, and flap.serial_number its own? `stand devices` lists all with theirs"
    return "is something in its way? its counts are of the feedback: compare open_target, closed_target and travel_s"


async def _check(look: DeviceCheck) -> None:
    """Check the flap's controller, and where it stands."""
    if look.settings is None:
        look.found("link", "ok", "no flap: cameras see the target all the time")
    else:
        await look.open_and_read()


KIND = DeviceKind(
    name="flap",
    settings=FlapSettings,
    make=_make,
    channels=(Channel("position", "1", "position"), Channel("current", "mA", "current")),
    section="flap",
    device="flap",
    rank=70,
    places=_places,
    address_key="backend_address",
    stand_in=NoFlap,
    missing=Absence("flap", "cameras see the target all the time; what opens or closes it takes no time"),
    advise=_advise,
    check=_check,
    verbs=(
        Verb("open", "open the flap", lambda stand, name, given: stand.move_flap(is_open=True)),
        Verb("close", "close the flap", lambda stand, name, given: stand.move_flap(is_open=False)),
    ),
)
